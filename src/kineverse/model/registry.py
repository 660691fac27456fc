"""Registry of readers and writers of models, which are in packages above the model.

A model imports nothing from above. It asks here for the reader of a source, by the address scheme or by the
suffix of the file, for the writer of a file, and for the shorthands of other packages. Entries are texts,
``"package.module:function"``, which are imported at first use. So a registration costs no start-up time.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from msgspec import Struct, field

from kineverse.errors import InvalidValueError, UnknownNameError, suggest

from .operation import Operation

if TYPE_CHECKING:
    from .edit import Edit

LoopTreatment: TypeAlias = Literal["solve", "constraint", "refuse"]

LOOP_TREATMENTS: tuple[LoopTreatment, ...] = get_args(LoopTreatment)


def check_loops(loops: object) -> None:
    """Raise unless the value is one of the treatments of loops."""
    if loops not in LOOP_TREATMENTS:
        raise InvalidValueError(
            "loops= is 'solve', which keeps as constraints what cannot be solved, 'constraint' or 'refuse', "
            f"not {loops!r}."
        )


# -- records -------------------------------------------------------------------------------------------------


class FileContent(Struct, frozen=True):
    """Content of a model file and the options of its reader."""

    path: Path
    content: bytes  # all bytes of the file
    prefix: str | None  # prefix of all names, without the slash; None for none
    root: str  # folder below which the reader may open further files
    strict: bool  # True if mistakes that have no effect on motion are errors
    shipped: str | None = None  # name of the model if it comes with the package
    arguments: Mapping[str, str] = field(default_factory=dict)  # arguments of a template, by name


class SourceFile(Struct, frozen=True):
    """File that a model was loaded from, and how it was read."""

    path: Path
    digest: bytes  # BLAKE2b of its bytes
    prefix: str | None = None  # prefix of all names
    root: str = ""  # folder below which it opened further files
    shipped: str | None = None  # name of the model if it comes with the package


class FileFormat(Struct, frozen=True):
    """File format of models, with its reader and its writer."""

    name: str
    suffixes: tuple[str, ...]  # endings of the file names that it reads
    read: str  # function from a FileContent to an iterable of (tag, operation), or of entries if it is exact
    written: tuple[str, ...] = ()  # endings of the file names that it writes
    write: str = ""  # function of (model, path, leave_out, tolerance, strict) to the content of files
    recognize: Callable[[str, bytes], bool] | None = None  # of (name, content), where formats share a suffix
    exact: bool = False  # True if files hold all of a model; then write is a function of (model, path)
    engine: str = ""  # class that reads files of the format on its own, to compare poses; empty for none
    folder_file: str = ""  # name of the file that stands for its folder; empty if none does
    loop_element: str = ""  # element of the format that closes a loop; empty if the format has none
    reference: bytes = b""  # text in every file that refers to further files; empty if files never do

    def reads(self, name: str, content: bytes) -> bool:
        """Return whether the format reads a file of this name and content."""
        return name.endswith(self.suffixes) if self.recognize is None else self.recognize(name, content)

    def operations(self, file: FileContent) -> Iterable[Any]:
        """Yield the operations of a file, each with its tag; of an exact format, entries of a history."""
        result: Iterable[Any] = import_entry(self.read)(file)
        return result


class ModelCollection(Struct, frozen=True):
    """Models that functions build, or documents that ship, loaded as ``collection/name``."""

    list_names: str  # function that returns all names
    summary: str  # number of its models, for errors: "one for each ..."
    build: str = ""  # function from a name and a prefix to an iterable of operations; empty for documents
    find_document: str = ""  # function from a name to the path of its document; empty if models are built
    accept: str = ""  # predicate of names, if list_names has examples alone; empty if it has all names
    prefix: str = ""  # prefix of a model by default; that of an empty text is the name of the model

    def has(self, name: str) -> bool:
        """Return whether there is a model of this name."""
        return bool(import_entry(self.accept)(name)) if self.accept else name in self.names()

    def names(self) -> tuple[str, ...]:
        """Return the names of the models, or examples of them."""
        return tuple(import_entry(self.list_names)())

    def document(self, name: str) -> Path | None:
        """Return the path of the document of a model; None for a model that is built."""
        return import_entry(self.find_document)(name) if self.find_document else None

    def operations(self, name: str, prefix: str | None) -> Iterator[Operation]:
        """Yield the operations of a model that is built."""
        yield from import_entry(self.build)(name, prefix)


class Scheme(Struct, frozen=True):
    """Addresses of live models, ``scheme:...``."""

    load: str  # function of (source, frames=, symbols=, bodies=) to a model, of the part that is asked for
    include: str  # function of (edit, source, prefix) that appends what the model contains now; returns tags


class FrameDeviation(Struct, frozen=True):
    """Upper bound on the error of a frame while all coordinates are within their limits.

    ``position`` bounds the distance of the origin from its true place [m], ``angle`` the angle of the
    remaining rotation [rad].
    """

    position: float = 0.0
    angle: float = 0.0

    def __str__(self) -> str:
        return f"{self.position:.3g} m and {self.angle:.3g} rad"


class SaveResult(Struct, frozen=True):
    """Report on a model that was saved."""

    path: Path  # path of the file
    remarks: tuple[str, ...] = ()  # differences between the file and the model that are no errors
    errors: Mapping[str, FrameDeviation] = field(default_factory=dict)  # bounds, where a tolerance allows any
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def error(self) -> FrameDeviation:
        """The largest of the errors."""
        found = self.errors.values()
        return FrameDeviation(
            max((e.position for e in found), default=0.0), max((e.angle for e in found), default=0.0)
        )


# -- entries -------------------------------------------------------------------------------------------------

COLLECTIONS: Mapping[str, ModelCollection] = {
    "articulations": ModelCollection(
        "kineverse.gallery:names",
        summary="one for each articulation",
        find_document="kineverse.gallery:find_document",
    ),
    "kitchens": ModelCollection(
        "kineverse.gallery.kitchens:example_seeds",
        summary="one for each seed from 0 on",
        build="kineverse.gallery.kitchens:kitchen_operations",
        accept="kineverse.gallery:is_seed",
        prefix="kitchen",
    ),
    "lockboxes": ModelCollection(
        "kineverse.gallery.lockboxes:example_boxes",
        summary="one for each seed from 0 on",
        build="kineverse.gallery.lockboxes:lockbox_operations",
        accept="kineverse.gallery.lockboxes:has_lockbox",
        prefix="lockbox",
    ),
}
"""Collections of models by the first part of their names."""

_FORMATS = "kineverse.formats.file_formats:list_file_formats"
"""Function that returns the file formats; of those that read the same file, the first one counts."""

_SHORTHANDS = {"close_loop": "kineverse.loops.close_loop:CloseLoop"}
"""Operations that an edit appends under a method's name."""

_SERVICES = {
    "include": "kineverse.formats.loader:include",
    "read_mesh": "kineverse.geometry.mesh_files:read_mesh",
    "save": "kineverse.formats.saver:save",
}
"""Readers and writers of files, and the reader of meshes."""

_SCHEMES: Mapping[str, Scheme] = {
    "live": Scheme(
        load="kineverse.exchange.client:load_live", include="kineverse.exchange.client:include_live"
    ),
}
"""Addresses of models that are served, by what stands before their colon."""

Service: TypeAlias = Literal["include", "save", "read_mesh"]


@cache
def list_formats() -> tuple[FileFormat, ...]:
    """Return all file formats."""
    return tuple(import_entry(_FORMATS)())


# -- queries -------------------------------------------------------------------------------------------------


def include_source(edit: Edit, source: Any, prefix: str | None, **options: Any) -> list[str]:
    """Append the operations of a source to an edit, and return their tags.

    A text ``scheme:…`` with a registered scheme is an address; any other source is a file or a name. Options
    of files are refused for an address.
    """
    scheme = find_scheme(source)
    if scheme is not None:
        check_no_file_options(**options)
        added: list[str] = import_entry(scheme.include)(edit, source, prefix)
        return added
    tags: list[str] = find_service("include")(edit, source, prefix, **options)
    return tags


def check_no_file_options(
    *, root: object = None, strict: object = False, loops: object = "solve", arguments: object = None
) -> None:
    """Check that no option is given that is about a file, as a live model is none."""
    given = {
        "root=": root is not None,
        "strict=": strict is not False,
        "loops=": loops != "solve",
        "arguments=": bool(arguments),
    }
    for name, is_given in given.items():
        if is_given:
            raise InvalidValueError(
                f"{name} is about reading a file, and a live model is none. Leave it out."
            )


def find_scheme(source: object) -> Scheme | None:
    """Return the scheme of an address; None if the source is no address with a registered one."""
    if not isinstance(source, str):
        return None
    scheme, colon, _ = source.partition(":")
    return _SCHEMES.get(scheme) if colon else None


def find_format(name: str, content: bytes) -> FileFormat | None:
    """Return the format of a file; None if no registered format reads it."""
    return next((one for one in list_formats() if one.reads(name, content)), None)


def find_folder_file(folder: Path) -> Path | None:
    """Return the file that stands for a folder, such as that of an object of PartNet-Mobility."""
    files = (folder / one.folder_file for one in list_formats() if one.folder_file)
    return next((file for file in files if file.is_file()), None)


def find_writer(name: str) -> FileFormat | None:
    """Return the format that writes files of this name; None if none does."""
    return next((one for one in list_formats() if name.endswith(one.written)), None)


def make_shorthand(name: str, /, **parameters: Any) -> Operation:
    """Return an operation of the class that is registered for a method of an edit."""
    if name not in _SHORTHANDS:
        raise UnknownNameError(
            f"No operation is registered as {name!r}. {suggest(name, _SHORTHANDS, 'operation')}"
        )
    operation: Operation = import_entry(_SHORTHANDS[name])(**parameters)
    return operation


def find_service(name: Service) -> Callable[..., Any]:
    """Return a registered function of a package above."""
    return import_entry(_SERVICES[name])


def readable_suffixes() -> tuple[str, ...]:
    """Return the endings of all file names that a registered format reads."""
    return tuple(dict.fromkeys(suffix for one in list_formats() for suffix in one.suffixes))


def writable_suffixes() -> tuple[str, ...]:
    """Return the endings of all file names that a registered format writes."""
    return tuple(dict.fromkeys(suffix for one in list_formats() for suffix in one.written))


@cache
def import_entry(entry: str) -> Callable[..., Any]:
    """Import the function of an entry ``"package.module:function"``."""
    module, _, name = entry.partition(":")
    result: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return result
