"""Formats whose readers are fuzzed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

import msgspec
import mujoco  # noqa: F401  - its import opens files, so it comes before the files are watched

import kineverse as kv
from kineverse import gallery
from kineverse.formats.document import read_operations
from kineverse.formats.document.structs import Document
from kineverse.formats.mjcf import parse_mjcf
from kineverse.formats.mjcf.operations import mjcf_operations
from kineverse.formats.sdf.operations import sdf_operations
from kineverse.formats.sdf.reader import parse_sdf
from kineverse.formats.urdf import parse_urdf
from kineverse.formats.urdf.operations import urdf_operations

from . import json_trees, programs, xml_trees
from .grammars import document, mjcf, sdf, urdf

SEEDS = Path(__file__).parent / "seeds"
# Descriptions that other people published, see tests/DATA.md.
DATA = os.environ.get("KINEVERSE_TEST_DATA")
MAX_SEED = 20_000
"""Size [byte] of the largest seeds; larger files are slow and contain nothing new."""

Operations = Iterable[tuple[str | None, kv.Operation]]


@dataclass(frozen=True)
class Target:
    """Format with its reader and the sources of its inputs.

    Attributes
    ----------
    suffix
        Suffix of its files.
    operations
        Reader that returns the operations of a text in a folder, below a prefix.
    generate
        Returns an input by grammar, valid or invalid.
    mutate
        Mutates an input with parts of a second one.
    reduce
        Yields smaller inputs with the structure of the format, for minimisation.
    finite
        True if poses have to be finite; not in formats with arbitrary expressions.
    examples
        Returns further seeds.
    mark
        Text that all of its files contain, and other files of that suffix do not.
    """

    name: str
    suffix: str
    operations: Callable[[bytes, Path, str | None], Operations]
    generate: Callable[[Random], bytes]
    mutate: Callable[[bytes, bytes, Random], bytes]
    reduce: Callable[[bytes], Iterator[bytes]]
    finite: bool = True
    examples: Callable[[], list[bytes]] = list
    mark: bytes = b""

    def seeds(self) -> list[bytes]:
        """Return the seeds: own inputs, small published files, and examples."""
        own = sorted(SEEDS.glob(f"*{self.suffix}"))
        found = sorted(Path(DATA).rglob(f"*{self.suffix}")) if DATA else []
        small = [path for path in found if path.is_file() and path.stat().st_size <= MAX_SEED]
        read = [path.read_bytes() for path in (*own, *small)]
        return [data for data in read if self.mark in data] + self.examples()

    def own_seeds(self) -> list[bytes]:
        """Return the inputs that were written for the format."""
        return [path.read_bytes() for path in sorted(SEEDS.glob(f"*{self.suffix}"))]


def _urdf(data: bytes, folder: Path, prefix: str | None) -> Operations:
    robot = parse_urdf(data, source="input.urdf", folder=str(folder))
    return ((None, operation) for operation in urdf_operations(robot, prefix))


def _sdf(data: bytes, folder: Path, prefix: str | None) -> Operations:
    scene = parse_sdf(data, source="input.sdf", folder=str(folder))
    return ((None, operation) for operation in sdf_operations(scene, prefix))


def _mjcf(data: bytes, folder: Path, prefix: str | None) -> Operations:
    scene = parse_mjcf(data, source="input.xml", folder=str(folder))
    return ((None, operation) for operation in mjcf_operations(scene, prefix))


def _document(data: bytes, folder: Path, prefix: str | None) -> Operations:
    return list(read_operations(data, "input.kv.json", prefix))


def _packed(data: bytes, folder: Path, prefix: str | None) -> Operations:
    return list(read_operations(data, "input.kv.msgpack", prefix, is_packed=True))


def _in_msgpack(data: bytes) -> bytes:
    """Return a text as msgpack, in the only form that is read if it is a document."""
    try:
        return msgspec.msgpack.encode(msgspec.json.decode(data, type=Document))
    except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError):
        pass
    return json_trees.MSGPACK.write(json_trees.JSON.read(data))


def _examples() -> list[bytes]:
    """Return documents of programs and of scenes."""
    return [programs.document(Random(seed)) for seed in range(40)] + _scenes()


def _scenes() -> list[bytes]:
    """Return the scenes of the gallery as documents, without their hashes, so that they can be changed."""
    found = []
    for name in gallery.names():
        tree = json.loads(gallery.find_document(name).read_text(encoding="utf-8"))
        tree.pop("sha256", None)
        tree["operations"] = [one for one in tree["operations"] if one["kind"] != "SetBody"]
        found.append(json.dumps(tree).encode())
    return [data for data in found if len(data) <= MAX_SEED]


TARGETS = {
    target.name: target
    for target in (
        Target(
            "urdf", ".urdf", _urdf, urdf.generate, xml_trees.mutator(urdf.VOCABULARY), xml_trees.reductions
        ),
        Target("sdf", ".sdf", _sdf, sdf.generate, xml_trees.mutator(sdf.VOCABULARY), xml_trees.reductions),
        Target(
            "mjcf",
            ".xml",
            _mjcf,
            mjcf.generate,
            xml_trees.mutator(mjcf.VOCABULARY),
            xml_trees.reductions,
            mark=b"<mujoco",
        ),
        Target(
            "document",
            ".kv.json",
            _document,
            document.generate,
            json_trees.mutator(document.VOCABULARY, json_trees.JSON),
            json_trees.reducer(json_trees.JSON),
            finite=False,
            examples=_examples,
        ),
        Target(
            "packed",
            ".kv.msgpack",
            _packed,
            lambda random: _in_msgpack(document.generate(random)),
            json_trees.mutator(document.VOCABULARY, json_trees.MSGPACK),
            json_trees.reducer(json_trees.MSGPACK),
            finite=False,
            examples=lambda: [_in_msgpack(data) for data in _examples()],
        ),
    )
}
