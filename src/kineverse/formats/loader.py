"""Loading of models from files and by name, with a cache of the latest ones."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TypeAlias

from kineverse._runtime import no_collection
from kineverse.errors import FormatError, InvalidValueError, KineverseError, MissingDependencyError
from kineverse.model import registry
from kineverse.model.edit import Edit
from kineverse.model.history import HistoryEntry
from kineverse.model.model import Model, Snapshot
from kineverse.model.registry import FileContent, FileFormat, LoopTreatment, SourceFile, check_loops
from kineverse.symbols import Symbol

from .file_formats import DOCUMENT_SUFFIXES
from .files import read_file
from .locate import Source, locate_model
from .names import check_prefix
from .reader_warnings import collect_warnings, warn
from .root_folder import NOWHERE, find_root

READ = (
    "URDF (.urdf, .xml), SDF (.sdf, .world), MJCF (.xml, .mjcf), USD (.usda, .usdc, .usd), PartNet-Mobility "
    "(mobility_v2.json), templates of xacro (.xacro) and documents (.kv.json, .kv.msgpack)"
)

_MESHES = (".stl", ".obj", ".dae", ".ply", ".glb", ".gltf", ".off", ".3mf", ".msh")

_ADVICE = {
    **dict.fromkeys(
        _MESHES,
        "is a mesh, and no model. A description names it as the shape of a link; "
        "'kineverse decompose' takes the file itself.",
    ),
    ".usdz": "is a package of USD, which is not read. Take the USD file out of it: unzip model.usdz",
    ".mjb": (
        "is a model that MuJoCo has compiled, which is not read. Load the MJCF it was made of, or write one: "
        "mujoco.mj_saveLastXML('model.xml', model)."
    ),
    ".srdf": (
        "is an SRDF, which names groups of joints of a robot that a URDF describes. Load the URDF, then "
        "kv.formats.read_srdf(path, model)."
    ),
    ".erb": "is a template. Expand it first: erb model.sdf.erb > model.sdf",
    ".config": "is the manifest of a model. Load the .sdf that it names.",
    ".mcap": (
        "is a recording, not a model. Play it with kineverse view, or read it with "
        "kineverse.worlds.read_run_recording(path)."
    ),
    ".launch": "is a launch file. Load the description that it starts.",
}


def unsupported_format_error(path: Path) -> FormatError:
    """Return the error for a file of another format, with the format and the remedy."""
    advice = _ADVICE.get(path.suffix.lower())
    if advice is not None:
        return FormatError(f"{path}: {advice}")
    return FormatError(
        f"{path}: this version reads {READ}, not '{''.join(path.suffixes) or path.name}'. "
        "Recordings of runs (.mcap) are for kineverse view."
    )


MOST_REMEMBERED = 16
LARGEST_REMEMBERED = 1 << 22
"""Largest file whose model is cached [byte]; larger models would take too much memory."""

# Models loaded by this process and the warnings about them, the latest last, by all inputs of the load.
_Key: TypeAlias = "tuple[Source, str | None, bytes, str, bool, str]"
_REMEMBERED: OrderedDict[_Key, tuple[Snapshot, list[str]]] = OrderedDict()


def load(
    source: str | os.PathLike[str],
    prefix: str | None = None,
    *,
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
    loops: LoopTreatment = "solve",
    arguments: Mapping[str, object] | None = None,
    frames: Iterable[str] | None = None,
    symbols: Iterable[Symbol | str] | None = None,
    bodies: bool | None = None,
) -> Model:
    """Load a model from a file or by name, or join a live one.

    Parameters
    ----------
    source
        Path of a ``.urdf``, ``.sdf``, ``.xml`` (MJCF, or URDF), ``.usda``, ``.xacro``, ``.kv.json`` or
        ``.kv.msgpack`` file, or of a ``mobility_v2.json`` or its folder; or a name such as ``kitchen``,
        ``pr2`` or ``articulations/screw``, see :func:`kineverse.formats.locate.locate_model`. ``live:NAME``
        is a model that other processes edit as well: the result follows it, and edits of the result are
        theirs.
    prefix
        Prefix of the names of all frames and degrees of freedom, without the slash. A shipped model has its
        own name as prefix unless another is given (``screw`` for ``articulations/screw``); ``""`` means none.
    root
        Folder below which the description may open files: meshes and included descriptions. By default the
        folder of ``KINEVERSE_ROOT`` that contains it, else the repository or package around it, else its own
        folder.
    strict
        True to refuse mistakes that affect no motion, or that other parsers accept. Otherwise each is a
        warning, which :func:`kineverse.formats.reader_warnings.collect_warnings` collects and the logger
        ``kineverse.formats`` receives.
    loops
        Treatment of loops that an SDF or MJCF closes. ``"solve"``: dependent coordinates become functions of
        the free ones, see :class:`kineverse.CloseLoop`; if that fails, the closure is kept as an equality
        constraint, :class:`kineverse.loops.LoopConstraint`, with a warning. ``"constraint"``: all are kept as
        constraints. ``"refuse"``: a loop that cannot be solved is an error.
    arguments
        Arguments of a ``.xacro`` template by name. They may also follow the path, ``"arm.xacro side:=left"``.
    frames, symbols, bodies
        Part of a live model: what the poses of these frames and the constraints and rates of these symbols
        depend on, and whether with bodies. ``kitchen/*`` stands for all frames with names that begin so. By
        default all of it.

    Raises
    ------
    FormatError
        If the file is invalid, with file, line, element and reason; or for an invalid prefix or root.
    InvalidValueError
        If ``loops`` is none of these; or for a part of a file, or options of a file for a live model.

    Examples
    --------
    >>> kitchen = kv.load("kitchen")
    >>> kitchen
    <Model: 54 frames, 23 DoF, 46 constraints (version 1)>
    >>> kitchen.fk("kitchen/fridge_door_handle")({"kitchen/fridge_door": 0.5})[:3, 3].round(3)
    array([ 0.842, -1.403,  1.184])
    >>> kv.load("kitchen", prefix="left").frames["left/fridge_door"].parent
    'left/fridge'
    """
    check_prefix(prefix)
    check_loops(loops)
    scheme = registry.find_scheme(source)
    if scheme is not None:
        registry.check_no_file_options(root=root, strict=strict, loops=loops, arguments=arguments)
        if prefix is not None:
            raise InvalidValueError(
                f"A live model keeps its names. For a copy of it below a prefix: model.include({source!r}, "
                f"prefix={prefix!r})."
            )
        join = registry.import_entry(scheme.load)
        live: Model = join(source, frames=frames, symbols=symbols, bodies=bodies)
        return live
    if not (frames is None and symbols is None and bodies is None):
        raise InvalidValueError(
            "frames=, symbols= and bodies= choose a part of a live model, live:NAME; "
            f"{os.fspath(source)} is loaded as a whole."
        )
    source, given = _arguments(source, arguments)
    found = locate_model(source)
    content = _content(found)
    file_format = _format(found, content)
    reference = None if file_format is None else file_format.reference
    stands_alone = not reference or reference not in content.replace(b"\0", b"")  # UTF-16 has two bytes
    below = _root(found, root)
    key = found, prefix, hashlib.blake2b(content).digest(), below, strict, loops
    known = _REMEMBERED.pop(key, None)
    if known is None:
        model = Model()
        try:
            with collect_warnings() as remarks, no_collection(), model.edit() as edit:
                for _ in _applied(edit, found, content, prefix, below, strict, loops, given):
                    pass
        except KineverseError as error:
            is_document = found.path.name.endswith(DOCUMENT_SUFFIXES)
            if not is_document or isinstance(error, FormatError | MissingDependencyError):
                raise
            raise FormatError(f"{found.path}: its operations cannot be applied: {error}") from error
        if len(content) > LARGEST_REMEMBERED or not stands_alone:
            return model
        known = model.snapshot(), remarks
    else:
        model = known[0].model()
        warn(known[1])
    _REMEMBERED[key] = known
    while len(_REMEMBERED) > MOST_REMEMBERED:
        _REMEMBERED.popitem(last=False)
    return model


def include(
    edit: Edit,
    source: str | os.PathLike[str],
    prefix: str | None = None,
    *,
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
    loops: LoopTreatment = "solve",
) -> list[str]:
    """Append the operations of a file or shipped model to an edit and return their tags; see :func:`load`."""
    check_prefix(prefix)
    check_loops(loops)
    source, given = _arguments(source, None)
    found = locate_model(source)
    return list(_applied(edit, found, _content(found), prefix, _root(found, root), strict, loops, given))


def check_readable(content: bytes, path: Path) -> None:
    """Check that what a writer would write to a file is read again, with its loops."""
    source = Source(path)
    try:
        with collect_warnings(), no_collection(), Model().edit() as edit:
            for _ in _applied(edit, source, content, None, _root(source, None), False, "solve", {}):
                pass
    except KineverseError as error:
        raise FormatError(f"What would be written cannot be read again: {error}") from error


def _arguments(
    source: str | os.PathLike[str], arguments: Mapping[str, object] | None
) -> tuple[str | os.PathLike[str], dict[str, str]]:
    given = {str(name): str(value) for name, value in (arguments or {}).items()}
    if isinstance(source, str) and ":=" in source:
        from .xacro import split_arguments  # for start-up time, as the next

        source, more = split_arguments(source)
        given |= more
    if given and not os.fspath(source).endswith(".xacro"):
        raise InvalidValueError(
            f"{os.fspath(source)} takes no arguments such as {next(iter(given))}; templates (.xacro) do."
        )
    return source, given


def _applied(
    edit: Edit,
    source: Source,
    content: bytes,
    prefix: str | None,
    root: str,
    strict: bool,
    loops: LoopTreatment,
    arguments: Mapping[str, str],
) -> Iterator[str]:
    prefix = source.shipped if prefix is None else prefix
    file_format = _format(source, content)
    if file_format is not None:
        digest = hashlib.blake2b(content).digest()
        edit.record_source(SourceFile(source.path, digest, prefix or None, root, source.shipped))
        file = FileContent(source.path, content, prefix or None, root, strict, source.shipped, arguments)
        operations = file_format.operations(file)
    else:
        built = registry.COLLECTIONS[source.collection].operations(source.path.name, prefix or None)
        operations = ((operation.default_tag(), operation) for operation in built)
    if file_format is None or not file_format.loop_element:
        for item in operations:
            yield edit.link(item) if isinstance(item, HistoryEntry) else edit.apply(item[1], item[0])
        return
    # Imported when used, as most files have no loops: its imports take longer than a file.
    from .loop_closures import LoopClosures

    closures = LoopClosures(edit, edit.model, source.path.name, file_format.loop_element, loops)
    for item in operations:
        if isinstance(item, HistoryEntry):  # of a document inside the file
            yield edit.link(item)
        else:
            yield from closures.apply(*item)
    yield from closures.finish()


def _root(source: Source, root: str | os.PathLike[str] | None) -> str:
    if source.collection:
        return NOWHERE if root is None else find_root(NOWHERE, root)
    return find_root(source.path.parent, root, source.folder)


def _content(source: Source) -> bytes:
    return b"" if source.collection else read_file(source.path)


def _format(source: Source, content: bytes) -> FileFormat | None:
    if source.collection:
        return None
    file_format = registry.find_format(source.path.name, content)
    if file_format is None:
        raise unsupported_format_error(source.path)
    return file_format
