"""Loading of models from files and names, with a memory of the last ones."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from kineverse._gc import no_collection
from kineverse.errors import FormatError, InvalidValueError, KineverseError, MissingDependencyError
from kineverse.model.edit import Edit
from kineverse.model.frame import WORLD
from kineverse.model.model import Model, Snapshot
from kineverse.model.operation import Operation
from kineverse.shipped.bases import mobile_base

from .files import read_file
from .locate import Source, locate_model
from .names import check_prefix
from .reader_warnings import collect_warnings, warn
from .root_folder import NOWHERE, find_root
from .urdf.operations import urdf_operations
from .urdf.reader import parse_urdf
from .xml_reader import read_root_tag

READ = "URDF (.urdf, .xml), SDF (.sdf, .world), MJCF (.xml, .mjcf) and documents (.kv.json, .kv.msgpack)"

_MESHES = (".stl", ".obj", ".dae", ".ply", ".glb", ".gltf", ".off", ".3mf", ".msh")
_USD = (".usd", ".usda", ".usdc", ".usdz")

_ADVICE = {
    **dict.fromkeys(
        _MESHES,
        "is a mesh, and no model. A description names it as the shape of a link; "
        "'kineverse decompose' takes the file itself.",
    ),
    **dict.fromkeys(
        _USD, "is USD, which is not read. Convert it to URDF or MJCF with the tool that it comes from."
    ),
    ".mjb": (
        "is a model that MuJoCo has compiled, which is not read. Load the MJCF it was made of, or write one: "
        "mujoco.mj_saveLastXML('model.xml', model)."
    ),
    ".srdf": "is an SRDF, which names groups of joints of a robot that a URDF describes. Load the URDF.",
    ".erb": "is a template. Expand it first: erb model.sdf.erb > model.sdf",
    ".config": "is the manifest of a model. Load the .sdf that it names.",
    ".launch": "is a launch file. Load the description that it starts.",
}


def unsupported_format(path: Path) -> FormatError:
    """Return the error for a file of another format: what it is, and what to do."""
    if path.suffix.lower() == ".xacro":
        plain = path.name[: -len(path.suffix)]
        plain = plain if "." in plain else f"{plain}.urdf"
        return FormatError(
            f"{path}: is a template of xacro, which is not expanded here. "
            f"Run xacro first: xacro {path.name} > {plain}"
        )
    advice = _ADVICE.get(path.suffix.lower())
    if advice is not None:
        return FormatError(f"{path}: {advice}")
    return FormatError(f"{path}: this version reads {READ}, not '{''.join(path.suffixes) or path.name}'.")


LoopTreatment: TypeAlias = Literal["solve", "constraint", "refuse"]

LOOP_TREATMENTS: tuple[LoopTreatment, ...] = get_args(LoopTreatment)


def check_loops(loops: object) -> None:
    """Raise unless this is one of the ways in which loops are read."""
    if loops not in LOOP_TREATMENTS:
        raise InvalidValueError(
            "loops= is 'solve', which keeps as constraints what cannot be solved, 'constraint' or 'refuse', "
            f"not {loops!r}."
        )


MOST_REMEMBERED = 16
LARGEST_REMEMBERED = 1 << 22
"""Models whose files are larger than this [byte] are not remembered, they would take too much memory."""

# Models loaded by this process and remarks on them, the latest last, by everything that they follow from.
_Key: TypeAlias = "tuple[Source, str | None, bytes, str, bool, str]"
_REMEMBERED: OrderedDict[_Key, tuple[Snapshot, list[str]]] = OrderedDict()


def load(
    source: str | os.PathLike[str],
    prefix: str | None = None,
    *,
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
    loops: LoopTreatment = "solve",
) -> Model:
    """Load a model from a file or by name.

    Parameters
    ----------
    source
        The path of a ``.urdf``, ``.sdf``, ``.xml`` (MJCF, or URDF), ``.kv.json`` or ``.kv.msgpack`` file, or
        a name such as ``kitchen``, ``pr2`` or ``articulations/screw``, see
        :func:`kineverse.formats.locate.locate_model`.
    prefix
        Put in front of the names of all frames and degrees of freedom, with a slash. A model that ships has
        its own name as prefix unless another is given (``screw`` for ``articulations/screw``); ``""`` means
        none.
    root
        The folder below which the files that it names may be opened, meshes and included ones. By default the
        folder of ``KINEVERSE_ROOT`` that holds it, else the repository or package around it, else its own
        folder.
    strict
        Whether mistakes that move nothing, or that others read past, are refused. Otherwise there is a remark
        on each, which :func:`kineverse.formats.reader_warnings.collect_warnings` hears and the logger ``kineverse.formats``
        gets.
    loops
        What becomes of loops that an SDF or MJCF closes. ``"solve"``: coordinates follow others, see
        :class:`kineverse.CloseLoop`; where that cannot be done, the closure is kept as an equality
        constraint, :class:`kineverse.loops.LoopConstraint`, with a remark. ``"constraint"``: all are kept so.
        ``"refuse"``: what cannot be solved is an error.

    Raises
    ------
    UnknownNameError
        If there is no such model.
    FormatError
        If the file is not what it should be, with file, line, element and reason; or if the prefix or the
        root is not.
    InvalidValueError
        If ``loops`` is none of these.
    """
    check_prefix(prefix)
    check_loops(loops)
    found = locate_model(source)
    content = _content(found)
    remembered = _stands_alone(found, content)
    below = _root(found, root)
    key = found, prefix, hashlib.blake2b(content).digest(), below, strict, loops
    known = _REMEMBERED.pop(key, None)
    if known is None:
        model = Model()
        with collect_warnings() as remarks, _blaming(found.path), model.edit() as edit, no_collection():
            for _ in _applied(edit, found, content, prefix, below, strict, loops):
                pass
        if len(content) > LARGEST_REMEMBERED or not remembered:
            return model
        known = model.snapshot(), remarks
    else:
        model = known[0].model()
        warn(known[1])
    _REMEMBERED[key] = known
    while len(_REMEMBERED) > MOST_REMEMBERED:
        _REMEMBERED.popitem(last=False)
    return model


@contextmanager
def _blaming(path: Path) -> Iterator[None]:
    """Make it the fault of a document if its operations cannot be applied to the empty model."""
    try:
        yield
    except (FormatError, MissingDependencyError):
        raise
    except KineverseError as error:
        if path.name.endswith((".kv.json", ".kv.msgpack")):
            raise FormatError(f"{path}: its operations cannot be applied: {error}") from error
        raise


def include(
    edit: Edit,
    source: str | os.PathLike[str],
    prefix: str | None = None,
    *,
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
    loops: LoopTreatment = "solve",
) -> list[str]:
    """Append the operations of a file or shipped model to an edit, see :func:`load`; return their tags."""
    check_prefix(prefix)
    check_loops(loops)
    found = locate_model(source)
    return list(_applied(edit, found, _content(found), prefix, _root(found, root), strict, loops))


def _applied(
    edit: Edit,
    source: Source,
    content: bytes,
    prefix: str | None,
    root: str,
    strict: bool,
    loops: LoopTreatment,
) -> Iterator[str]:
    """Apply the operations of a source, and yield their tags."""
    name = source.path.name
    closing = "joint" if _is_sdf(name) else "equality" if _is_mjcf(name, content) else ""
    operations = _operations(source, content, prefix, root, strict)
    if not closing or source.scene:
        for tag, operation in operations:
            yield edit.apply(operation, tag)
        return
    from .loop_closures import LoopClosures  # of what few files close

    closures = LoopClosures(edit, edit.model, name, closing, loops)
    for tag, operation in operations:
        yield from closures.apply(tag, operation)
    yield from closures.finish()


def _root(source: Source, root: str | os.PathLike[str] | None) -> str:
    """Return the folder below which a model may open files."""
    if source.scene:
        return NOWHERE if root is None else find_root(NOWHERE, root)
    return find_root(source.path.parent, root, source.folder)


def _content(source: Source) -> bytes:
    return b"" if source.scene else read_file(source.path)


def _operations(
    source: Source, content: bytes, prefix: str | None, root: str, strict: bool
) -> Iterator[tuple[str, Operation]]:
    path, name = source.path, source.path.name
    if prefix is None:
        prefix = source.shipped
    prefix = prefix or None
    if source.scene:
        from kineverse import gallery  # when it is asked for

        for operation in gallery.operations(name, prefix):
            yield operation.default_tag(), operation
    elif name.endswith(".kv.json"):
        from .document import read_operations  # nor does every process read a document

        yield from read_operations(content, str(path), prefix, root)
    elif name.endswith(".kv.msgpack"):
        from .document import read_packed_operations

        yield from read_packed_operations(content, str(path), prefix, root)
    elif _is_mjcf(name, content):
        from .mjcf.operations import mjcf_operations
        from .mjcf.reader import parse_mjcf

        description = parse_mjcf(content, name, str(path.absolute().parent), root, strict)
        for operation in mjcf_operations(description, prefix):
            yield operation.default_tag(), operation
    elif name.endswith((".urdf", ".xml")):
        robot = parse_urdf(content, name, str(path.absolute().parent), root, strict)
        base = mobile_base(source.shipped, prefix) if source.shipped else None
        if base is not None:
            yield base.default_tag(), base
        parent = WORLD if base is None else base.child
        for operation in urdf_operations(robot, prefix, parent, strict):
            yield operation.default_tag(), operation
    elif _is_sdf(name):
        # Many modules, which most processes never need.
        from .sdf.operations import sdf_operations
        from .sdf.reader import parse_sdf

        scene = parse_sdf(content, name, str(path.absolute().parent), root, strict)
        for operation in sdf_operations(scene, prefix):
            yield operation.default_tag(), operation
    else:
        raise unsupported_format(path)


def _is_sdf(name: str) -> bool:
    return name.endswith((".sdf", ".world"))


def _is_mjcf(name: str, content: bytes) -> bool:
    return name.endswith(".mjcf") or (name.endswith(".xml") and read_root_tag(content).startswith("mujoco"))


def _stands_alone(source: Source, content: bytes) -> bool:
    """Return whether a model follows from its file alone: what a file names may change while it does not."""
    plain = content.replace(b"\0", b"")  # in two bytes a letter, too
    if _is_sdf(source.path.name):
        return b"include" not in plain
    return b"file" not in plain or not _is_mjcf(source.path.name, content)
