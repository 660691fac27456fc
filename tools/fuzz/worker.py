"""Coverage-guided search in one process, until it is stopped or an input kills it.

``python -m fuzz.worker --target urdf --folder build/fuzz/urdf --seconds 300`` searches.
With ``--replay FILE`` it checks one input and prints the violated invariant; it returns 1 if there is one.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
from pathlib import Path
from random import Random

MAX_LENGTH = 60_000
MAX_SPACE = 6 << 30
MAX_RESIDENT = 2048
"""Memory limit [MiB]; an input may take half of it, see :mod:`.invariants`."""
HANG = 20
"""Wall-clock time [s] after which an input counts as a hang; :mod:`.invariants` allows 5 s of CPU time."""


def main() -> int:
    """Search, or check one input."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.worker", description=__doc__)
    parser.add_argument("--target", required=True)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--replay", type=Path)
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MAX_SPACE, MAX_SPACE))
    os.environ.setdefault("KINEVERSE_CACHE_DIR", tempfile.gettempdir())
    if given.replay is None:
        _search(given.target, given.folder, given.seconds, given.seed)
        return 0
    return _replay(given.target, given.replay)


def _replay(name: str, path: Path) -> int:
    """Check one input."""
    from .check_options import choose_options
    from .invariants import check
    from .targets import TARGETS

    data = path.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        finding = check(TARGETS[name], data, make_input_folder(Path(folder)), options=choose_options(data))
    if finding is not None:
        sys.stdout.write(f"{finding.signature}\n\n{finding.detail}\n")
    return finding is not None


def _search(name: str, folder: Path, seconds: int, seed: int) -> None:
    """Run libFuzzer on a target."""
    import atheris

    with atheris.instrument_imports(include=["kineverse.formats"]):
        from .targets import TARGETS
    from .check_options import choose_options
    from .findings import FindingStore
    from .inputs import mutate_input
    from .invariants import OutcomeCounts, check

    target, records, counts = TARGETS[name], FindingStore(folder / "findings"), OutcomeCounts()
    beside = make_input_folder(Path(tempfile.mkdtemp(prefix="fuzz-")))
    others = target.seeds()
    status = folder / "status.json"

    def one(data: bytes) -> None:
        finding = check(target, data, beside, counts, choose_options(data))
        if finding is not None and records.add(finding, data):
            sys.stderr.write(f"FOUND {finding.signature}\n")
        if (counts.models + counts.errors) % 100 == 0:
            counted = {"models": counts.models, "errors": counts.errors}
            status.write_text(json.dumps(counted), encoding="utf-8")

    def mutate(data: bytes, max_size: int, chance: int) -> bytes:
        random = Random(chance)
        if random.random() < 0.1:
            return bytes(atheris.Mutate(data, max_size))
        return mutate_input(target, data, others, random)[:max_size]

    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(others):
        (corpus / f"seed-{number}").write_bytes(data[:MAX_LENGTH])
    options = {
        "max_total_time": seconds,
        "max_len": MAX_LENGTH,
        "timeout": HANG,
        "rss_limit_mb": MAX_RESIDENT,
        "seed": seed,
        "artifact_prefix": f"{folder}/died-",
        "len_control": 0,
        "verbosity": 1,
    }
    atheris.Setup(
        [name, *(f"-{key}={value}" for key, value in options.items()), str(corpus)],
        one,
        custom_mutator=mutate,
    )
    atheris.Fuzz()


def make_input_folder(folder: Path) -> Path:
    """Return a folder for inputs, with models that they may include."""
    folder = folder.resolve() / "inputs"
    part = folder / "part"
    part.mkdir(parents=True)
    (part / "model.config").write_text('<model><sdf version="1.7">model.sdf</sdf></model>', "utf-8")
    (part / "model.sdf").write_text(
        '<sdf version="1.7"><model name="part"><link name="a"/><link name="b"/>'
        '<joint name="j0" type="revolute"><parent>a</parent><child>b</child></joint></model></sdf>',
        "utf-8",
    )
    (folder / "bodies.xml").write_text(
        '<mujocoinclude><body name="i"><geom size="1"/></body></mujocoinclude>',
        "utf-8",
    )
    (folder / "part.xml").write_text(
        '<mujoco model="part"><worldbody><body name="x"><joint name="j"/><geom size="1"/>'
        '<body name="y" pos="1 0 0"/></body></worldbody></mujoco>',
        "utf-8",
    )
    return folder


if __name__ == "__main__":
    sys.exit(main())
