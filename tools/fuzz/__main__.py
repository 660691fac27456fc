"""Search for inputs that break a reader: ``make fuzz ARGS="--target sdf --minutes 60"``.

The search runs in separate processes, which an input may kill and which are then restarted. Minimised
findings are in build/fuzz/TARGET/findings, and inputs that reached new code in build/fuzz/TARGET/corpus.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from .check_options import CheckOptions, all_options
from .findings import FindingStore
from .invariants import Finding, check
from .minimise import minimise
from .targets import TARGETS, Target
from .worker import HANG, make_input_folder

ROUND = 300
"""Time [s] after which a process is replaced by a new one, since its caches grow."""
_COVERAGE = re.compile(r"cov: (\d+) ft: (\d+) corp: (\d+)")


def main() -> int:
    """Run the search and return the number of findings."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__)
    parser.add_argument("--target", choices=TARGETS, action="append", help="a format; may be repeated (all)")
    parser.add_argument("--minutes", type=float, default=10.0, help="how long, for all targets together (10)")
    parser.add_argument("--seed", type=int, default=1, help="of the search (1)")
    parser.add_argument(
        "--folder", type=Path, default=Path("build/fuzz"), help="where results go (build/fuzz)"
    )
    parser.add_argument("--check", type=Path, metavar="FILE", help="only look at one input, and minimise it")
    given = parser.parse_args()
    targets = given.target or list(TARGETS)
    if given.check is not None:
        return _check_file(TARGETS[targets[0]], given.check)
    searches = [_Search(TARGETS[name], given.folder / name) for name in targets]
    end, seed = time.monotonic() + 60 * given.minutes, given.seed
    try:
        while (left := end - time.monotonic()) > 1:
            for search in searches:
                search.round(int(max(1, min(ROUND, left / len(searches)))), seed)
                seed += 1
    except KeyboardInterrupt:
        _say("stopped")
    found = [line for search in searches for line in search.summary()]
    _say(f"{len(found)} found" + "".join(f"\n  {line}" for line in found))
    return min(len(found), 99)


class _Search:
    """Search for one target, over many processes."""

    def __init__(self, target: Target, folder: Path) -> None:
        self._target, self._folder = target, folder
        self._records = FindingStore(folder / "findings")
        self._models = self._errors = self._deaths = 0
        self._seconds = 0.0

    def round(self, seconds: int, seed: int) -> None:
        """Run a process for some seconds, and collect its results."""
        folder, log = self._folder, self._folder / "log.txt"
        status = folder / "status.json"
        status.unlink(missing_ok=True)
        command = ["--folder", str(folder), "--seconds", str(seconds), "--seed", str(seed)]
        start = time.monotonic()
        with log.open("wb") as file:
            process = subprocess.Popen(self._worker(*command), stdout=file, stderr=file)
            try:
                process.wait(seconds + 6 * HANG)
            except subprocess.TimeoutExpired:
                process.kill()
            finally:
                process.terminate()
                process.wait()
        self._seconds += time.monotonic() - start
        died = list(folder.glob("died-*"))
        for path in died:
            self._confirm_death(path)
        if status.exists():
            counts = json.loads(status.read_text("utf-8"))
            self._models, self._errors = self._models + counts["models"], self._errors + counts["errors"]
        elif process.returncode:
            raise SystemExit(f"the search ended at once:\n{log.read_text('utf-8', 'replace')[-3000:]}")
        if process.returncode and not died:
            _say(f"{self._target.name}: the fuzzer itself failed, see {log.rename(folder / 'failed.txt')}")
            return
        reached = _COVERAGE.findall(log.read_text("utf-8", "replace")) or [("0", "0", "0")]
        _say(f"{self._line()}; branches {reached[-1][0]}, inputs kept {reached[-1][2]}")

    def summary(self) -> list[str]:
        """Minimise all findings, and return a line for each."""
        _say(self._line())
        lines = []
        for signature, path in self._records.all():
            if signature.startswith(("dies", "slow", "large")):
                lines.append(f"{signature}: {path}")
                continue
            with tempfile.TemporaryDirectory() as folder:
                small = _minimise(self._target, path.read_bytes(), signature, make_input_folder(Path(folder)))
            path.write_bytes(small)
            lines.append(f"{signature}: {path} ({len(small)} bytes)")
        return lines

    def _confirm_death(self, path: Path) -> None:
        """Record an input that killed a process if it also kills a new process alone."""
        data, how = path.read_bytes(), path.name.split("-")[1]
        path.unlink()
        again = self._folder / "again"
        again.write_bytes(data)
        try:
            code = subprocess.run(
                self._worker("--replay", str(again)), timeout=3 * HANG, capture_output=True
            ).returncode
        except subprocess.TimeoutExpired:
            code = -1
        if code not in (0, 1):
            self._deaths += 1
            self._records.add(Finding(f"dies: {how}", f"the process ends with {code}"), data)

    def _worker(self, *arguments: str) -> list[str]:
        """Return the command line of a search process."""
        return [sys.executable, "-m", "fuzz.worker", "--target", self._target.name, *arguments]

    def _line(self) -> str:
        """Return the state of the search as a line."""
        runs = self._models + self._errors
        return (
            f"{self._target.name}: {runs} inputs in {self._seconds / 60:.1f} min, "
            f"{self._models} gave models; {len(self._records.all())} findings, {self._deaths} deaths"
        )


def _check_file(target: Target, path: Path) -> int:
    """Check one input with all options, and print its minimised form if an invariant is violated."""
    data = path.read_bytes()
    with tempfile.TemporaryDirectory() as name:
        folder = make_input_folder(Path(name))
        found = (check(target, data, folder, options=options) for options in all_options())
        finding = next(filter(None, found), None)
        if finding is None:
            _say("nothing is wrong")
            return 0
        small = _minimise(target, data, finding.signature, folder)
    sys.stdout.write(f"{finding.signature}\n{finding.detail}\n\n{small.decode(errors='backslashreplace')}\n")
    return 1


def _minimise(target: Target, data: bytes, signature: str, folder: Path) -> bytes:
    """Minimise an input with the first options that give its signature."""
    for options in all_options():

        def fails(candidate: bytes, options: CheckOptions = options) -> bool:
            finding = check(target, candidate, folder, options=options)
            return finding is not None and finding.signature == signature

        if fails(data):
            return minimise(data, target, fails)
    return data


def _say(text: str) -> None:
    """Print a line with the time."""
    sys.stdout.write(f"{time.strftime('%H:%M:%S')} {text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    os.environ["PYTHONPATH"] = os.pathsep.join(
        filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")))
    )
    sys.exit(main())
