"""MuJoCo, called so that nothing is printed, logged to a file or raised in its own words."""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from kineverse.errors import FormatError, MissingExtraError
from kineverse.installation import install_command

from .preparing import Prepared

_ALONE = threading.Lock()
_LINE = re.compile(r"line (\d+)")
_NOISE = re.compile(r"^(XML Error: |Error: |could not parse model file with error: )+")


def mujoco() -> Any:
    """Return the package, which is imported when it is first needed.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        import mujoco as package
    except ImportError as error:
        raise MissingExtraError(f"Reading MJCF needs MuJoCo's parser: {install_command('mjcf')}") from error
    return package


@contextmanager
def listening() -> Iterator[list[str]]:
    """Yield a list that takes MuJoCo's warnings, which would go to the terminal and a file otherwise."""
    engine = mujoco()
    heard: list[str] = []
    with _ALONE, warnings.catch_warnings(record=True) as warned:  # both are one for all of the process
        warnings.simplefilter("always")
        before = engine.get_mju_user_warning()
        engine.set_mju_user_warning(heard.append)
        try:
            yield heard
        finally:
            engine.set_mju_user_warning(before)
            heard += [str(warning.message) for warning in warned]


def parse(prepared: Prepared, source: str) -> Any:
    """Return the ``MjSpec`` of a document.

    Raises
    ------
    FormatError
        With what MuJoCo says about which element.
    """
    engine = mujoco()
    try:
        return engine.MjSpec.from_string(prepared.text, include=prepared.models)
    except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
        raise refusal(error, prepared, source) from None


def compiled(spec: Any, prepared: Prepared, source: str) -> Any:
    """Return the ``MjModel`` of a specification.

    Raises
    ------
    FormatError
        With what MuJoCo says about which element.
    """
    engine = mujoco()
    try:
        return spec.compile()
    except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
        raise refusal(error, prepared, source) from None


def refusal(error: Exception, prepared: Prepared, source: str) -> FormatError:
    """Return the error that people see for one of MuJoCo's."""
    text = str(error)
    reason = reason_of(text)
    lines = [int(number) for number in _LINE.findall(text)]
    # The innermost comes first: an attached model is complained about at the element that attaches it, too.
    node = prepared.node(f"line {lines[0]}") if lines else None
    where = source if node is None else node.where
    return FormatError(f"{where}: MuJoCo refuses it: {reason or 'it gives no reason'}.")


def reason_of(text: str, whole: bool = False) -> str:
    """Return the first line of what MuJoCo says, or all of its lines in one, without its own preamble."""
    lines = _NOISE.sub("", text.strip()).splitlines() or [""]
    return ", ".join(line.strip() for line in (lines if whole else lines[:1])).rstrip(".")
