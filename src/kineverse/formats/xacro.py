"""Templates of xacro (``robot.urdf.xacro``), expanded and read as the URDF or SDF that they are of.

The ``xacro`` package expands them, in a process of its own, see :mod:`.xacro_process`.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from dataclasses import replace

from kineverse._extras import install_command
from kineverse.errors import FormatError, InvalidValueError, MissingDependencyError
from kineverse.model import registry
from kineverse.model.operation import Operation
from kineverse.model.registry import FileContent

from .isolation import IsolatedCallError, call_isolated
from .reader_warnings import warn
from .xml_reader import read_root_tag


def xacro_file_operations(file: FileContent) -> Iterable[tuple[str, Operation]]:
    """Return the operations of the description that a template expands to."""
    content = expand_xacro(file)
    # Lines in messages are those of the text that it expands to.
    name = f"{file.path.name} (expanded)"
    expanded = replace(file, path=file.path.with_name(name), content=content)
    # An .xml is MJCF or URDF, by its root element.
    ending = ".sdf" if read_root_tag(content) == "sdf" else ".xml"
    found = registry.find_format(f"x{ending}", content)
    assert found is not None
    return found.operations(expanded)


def expand_xacro(file: FileContent) -> bytes:
    """Return the text that a template expands to; see :func:`xacro_file_operations` for errors."""
    if any(importlib.util.find_spec(name) is None for name in ("xacro", "yaml")):
        raise MissingDependencyError(
            f"{file.path.name} is a template of xacro, which is not installed: {install_command('xacro')}"
        )
    path = str(file.path.absolute())
    try:
        result: Mapping[str, object] = call_isolated(
            "kineverse.formats.xacro_process", "expand", path, file.root, dict(file.arguments)
        )
    except IsolatedCallError as error:
        raise FormatError(f"{file.path.name}: xacro does not expand it: {error}.") from None
    remarks = result["remarks"]
    assert isinstance(remarks, list)
    warn([f"{file.path.name}: {remark}" for remark in remarks])
    if "error" in result:
        raise FormatError(str(result["error"]))
    return str(result["text"]).encode()


def split_arguments(source: str) -> tuple[str, dict[str, str]]:
    """Split ``robot.urdf.xacro side:=left`` into a path and arguments."""
    path, *words = source.split(" ")
    while words and ":=" not in words[0]:
        path = f"{path} {words.pop(0)}"
    return path.rstrip(), parse_arguments(word for word in words if word)


def parse_arguments(words: Iterable[str]) -> dict[str, str]:
    """Return the arguments in words such as ``side:=left``."""
    found: dict[str, str] = {}
    for word in words:
        name, sign, value = word.partition(":=")
        if not sign or not name:
            raise InvalidValueError(f"{word!r} is no argument of a template; write name:=value.")
        found[name] = value
    return found
