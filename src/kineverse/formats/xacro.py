"""Templates of xacro (``robot.urdf.xacro``), expanded and read as the URDF or SDF that they are of.

The ``xacro`` package expands them, in a process that does nothing else. It evaluates expressions of Python by
``eval``, from which a lambda or a comprehension leads to all of Python. Here they are checked first:
:func:`check_expression` allows arithmetic, comparisons, indices, literals, comprehensions and calls, but no
attribute that begins with an underscore or leads to frames, code or types, and no lambda. Files are opened
below the root of the description and in packages only.
"""

from __future__ import annotations

import ast
import importlib.util
import io
import os
import re
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from kineverse._extras import install_command
from kineverse.errors import FormatError, InvalidValueError, MissingDependencyError, summarize_error
from kineverse.model import registry
from kineverse.model.operation import Operation
from kineverse.model.registry import FileContent

from .files import MAX_BYTES, read_file
from .isolation import MEMORY, IsolatedCallError, call_isolated
from .reader_warnings import warn
from .resource_paths import find_package, may_open, named_folders
from .root_folder import is_below, outside_root_error
from .xml_reader import abbreviate, quote, read_root_tag


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
            "kineverse.formats.xacro", "expand", path, file.root, dict(file.arguments)
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
    result: dict[str, str] = {}
    for word in words:
        name, sign, value = word.partition(":=")
        if not sign or not name:
            raise InvalidValueError(f"{word!r} is no argument of a template; write name:=value.")
        result[name] = value
    return result


_FORBIDDEN_NODES = (ast.Lambda, ast.NamedExpr, ast.Await, ast.Yield, ast.YieldFrom)
_INNER_TYPES = (
    *(types.FrameType, types.CodeType, types.TracebackType),
    *(types.GeneratorType, types.CoroutineType, types.AsyncGeneratorType),
)
# By name rather than by prefix, because data have keys such as f_max.
_FORBIDDEN_ATTRIBUTES = {"format", "format_map", "mro"} | {
    name for kind in _INNER_TYPES for name in dir(kind) if "_" in name and not name.startswith("_")
}
_FORBIDDEN_FUNCTIONS = ("type", "vars")


def expand(path: str, root: str, arguments: Mapping[str, str]) -> dict[str, Any]:
    """Expand a template and return ``text``, or ``error``, with ``remarks``."""
    import xacro  # an extra

    expansion = _Expansion(xacro, path, root)
    result: dict[str, Any] = {"remarks": expansion.remarks}
    try:
        given = _Arguments(arguments)
        document = xacro.process_file(path, mappings=given)
        expansion.check_arguments(arguments, given.used)
        result["text"] = text = document.toxml()
        if len(text) > MAX_BYTES:
            raise FormatError(f"it expands to more than {MAX_BYTES} characters, the most that is read.")
    except RecursionError:
        result["error"] = f"{expansion.where()}: macros or includes nest too deeply, or without end."
    except Exception as error:  # xacro raises all kinds of exceptions
        result["error"] = f"{expansion.where()}: {_reason(error)}"
    return result


def check_expression(text: str, allowed: type[Exception]) -> None:
    """Check that an expression calls nothing but what xacro gives it."""
    for node in ast.walk(ast.parse(text.strip(), mode="eval")):
        name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
        is_attribute = isinstance(node, ast.Attribute)
        if is_attribute and name in _FORBIDDEN_ATTRIBUTES:
            raise allowed(
                f"the name {name!r} is not allowed in an expression after a dot; a key is ['{name}']"
            )
        if name.startswith("_" if is_attribute else "__"):
            raise allowed(f"the name {name!r} is not allowed in an expression")
        if isinstance(node, _FORBIDDEN_NODES):
            raise allowed(f"a {type(node).__name__.lower()} is not allowed in an expression")


class _Arguments(dict[str, str]):
    """Arguments of a template, with the names of those that it uses, which it need not declare."""

    def __init__(self, given: Mapping[str, str]) -> None:
        super().__init__(given)
        self.used: set[str] = set()

    def __getitem__(self, name: str) -> str:
        self.used.add(name)
        return super().__getitem__(name)


class _Expansion:
    """xacro with checked expressions and files, and with the places of elements for errors."""

    def __init__(self, xacro: Any, path: str, root: str) -> None:
        self._xacro, self._path, self._root = xacro, path, root
        self._folder = os.path.dirname(path)
        self.remarks: list[str] = []
        self._packages: dict[str, str] = {}
        self._found: set[str] = set()
        self._declared: set[str] = set()
        self._failed: Any = None
        xacro.verbosity = 0
        xacro.warning = lambda *words, **_: self._remark(" ".join(map(str, words)))
        self._restrict_expressions()
        self._restrict_files()
        self._keep_places()

    def where(self) -> str:
        file, line = getattr(self._failed, "place", (self._path, 0))
        tag = getattr(self._failed, "tagName", "")
        parts = os.path.basename(file), line and f"line {line}", tag and f"<{abbreviate(tag)}>"
        return ", ".join(part for part in parts if part)

    def check_arguments(self, given: Mapping[str, str], used: set[str]) -> None:
        self._failed = None
        unknown = [name for name in given if name not in self._declared | used]
        if unknown:
            known = ", ".join(sorted(self._declared)) or "none"
            raise FormatError(f"it has no argument {quote(unknown[0])}. Its arguments: {known}.")

    def _remark(self, text: str) -> None:
        if text not in self.remarks:
            self.remarks.append(text)

    def _restrict_expressions(self) -> None:
        """Check expressions before they are evaluated, without the builtins of Python."""
        xacro = self._xacro
        from xacro import substitution_args

        plain, refuse = xacro.safe_eval, xacro.XacroException

        def evaluate(text: str, names: Any, local: Any = None) -> Any:
            check_expression(text, refuse)
            return plain(text, names, local)

        def evaluate_substitution(text: str, context: dict[str, Any]) -> str:
            check_expression(text, substitution_args.SubstitutionException)
            known = context.get("arg", {})

            def argument(name: str) -> object:
                return substitution_args.convert_value(known[name], "auto")

            # Only those that it names, so that a misspelt argument of the user is still found.
            given = {name: argument(name) for name in re.findall(r"\w+", text) if name in known}
            names = {k: v for k, v in substitution_args._eval_dict.items() if not k.startswith("_")}
            own = {"arg": argument, "dirname": lambda: os.path.dirname(xacro.filestack[-1])}
            basic = substitution_args._eval_dict["__builtins__"]
            return str(eval(text.strip(), {"__builtins__": basic}, given | names | own))

        xacro.safe_eval = evaluate
        substitution_args._eval = evaluate_substitution
        substitution_args._eval_find = substitution_args._eval_dict["find"] = self._find_package
        for name in _FORBIDDEN_FUNCTIONS:
            xacro._global_symbols["python"].pop(name, None)

    def _restrict_files(self) -> None:
        """Open files only where a description may."""
        xacro = self._xacro
        parse, load_yaml, include = xacro.parse, xacro.load_yaml, xacro.get_include_files

        def checked_parse(inp: Any, filename: str | None = None) -> Any:
            if inp is None:
                try:
                    self._check_file(str(filename))
                except xacro.XacroException:
                    xacro.filestack.pop()  # as xacro itself does, for optional files
                    raise
                # As bytes, of which the XML says the encoding.
                inp = io.BytesIO(read_file(Path(str(filename))))
            return parse(inp, filename)

        def checked_yaml(filename: str) -> Any:
            self._check_file(xacro.abs_filename_spec(filename))
            return load_yaml(filename)

        def wanted_files(specification: str, symbols: Any) -> Any:
            self._wanted = specification
            return include(specification, symbols)

        self._wanted = ""
        xacro.parse, xacro.load_yaml, xacro.get_include_files = checked_parse, checked_yaml, wanted_files
        for names in (xacro._global_symbols, xacro._global_symbols["xacro"]):
            names["load_yaml"] = checked_yaml

    def _check_file(self, path: str) -> None:
        plain, real = os.path.normpath(path), os.path.realpath(path)
        # What is taken for a package that is not there opens nothing.
        inside = any(is_below(real, package) for package in self._found)
        # As for package://, links are followed in the folders that the user names: an installed workspace is
        # full of links to its sources.
        if not inside and os.path.realpath(plain) == real:
            inside = any(is_below(plain, folder) for folder in named_folders())
        if not inside and not may_open(path, self._root, self._folder):
            raise outside_root_error(path, self._root)
        if not os.path.isfile(real):
            raise self._xacro.XacroException(f"there is no file {quote(path)}.", exc=FileNotFoundError())

    def _find_package(self, name: str) -> str:
        if name not in self._packages:
            match = re.match(rf"\s*\$\(find\s+{re.escape(name)}\s*\)/*([^$]*)$", self._wanted)
            folder, is_substitute = find_package(name, self._folder, self._root, match[1] if match else "")
            if is_substitute:
                self._remark(f"there is no package {quote(name)}; {folder} is taken for it.")
            else:
                self._found.add(os.path.realpath(folder))
            self._packages[name] = os.path.abspath(folder)
        return self._packages[name]

    def _keep_places(self) -> None:
        """Give each element its file and line, and keep the innermost one at which xacro fails."""
        from xml.dom import expatbuilder, minidom

        xacro = self._xacro
        start, clone = expatbuilder.ExpatBuilderNS.start_element_handler, minidom._clone_node  # type: ignore[attr-defined]

        def start_with_place(builder: Any, name: str, attributes: Any) -> None:
            start(builder, name, attributes)
            builder.curNode.place = xacro.filestack[-1], builder._parser.CurrentLineNumber

        def clone_with_place(node: Any, *more: Any) -> Any:
            copy = clone(node, *more)
            if hasattr(node, "place"):
                copy.place = node.place
            return copy

        expatbuilder.ExpatBuilderNS.start_element_handler = start_with_place  # type: ignore[assignment, method-assign]
        minidom._clone_node = clone_with_place  # type: ignore[attr-defined]
        functions = "check_attrs grab_property grab_macro process_include handle_macro_call eval_all"
        for name in functions.split():
            setattr(xacro, name, self._noting(getattr(xacro, name)))

    def _noting(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of an element that keeps the element if it raises."""

        def noting(node: Any, *more: Any) -> Any:
            try:
                result = function(node, *more)
            except Exception:
                if self._failed is None and hasattr(node, "place"):
                    self._failed = node
                raise
            if function.__name__ == "check_attrs" and node.tagName == "xacro:arg":
                self._declared.add(result[0])
            return result

        return noting


def _reason(error: Exception) -> str:
    """Return the message of an error of xacro on one line, without its own account of the place."""
    inner = getattr(error, "exc", None)
    if isinstance(inner, FormatError):
        return str(inner)
    if isinstance(inner or error, MemoryError):
        return f"it takes more than {MEMORY >> 30} GiB of memory."
    if type(inner).__name__ == "ArgException":
        return f"it needs the argument {quote(str(inner))}, which has no default here: {inner}:=VALUE."
    text = str(error)
    if isinstance(error, FormatError):
        return text
    if inner is not None and text.startswith("<class"):  # xacro repeats the error with its type
        text = str(inner)
    return " ".join(text.split()) or summarize_error(error)
