"""Standard streams of a command: safe for terminals, in any encoding, and also if they cannot be written."""

from __future__ import annotations

import codecs
import contextlib
import os
import re
import sys
import unicodedata
from collections.abc import Iterator
from typing import Any, TextIO

from kineverse.errors import FormatError

# Control characters other than tab and line feed, and those that turn the direction of writing.
_UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
# What this program itself writes to terminals: colours, and the end of a line.
_OWN = re.compile("(\033\\[[0-9]{1,2}m|\r\033\\[K)")

_PLAIN = {
    "→": "->", "←": "<-", "±": "+-", "°": "deg", "µ": "u", "μ": "u", "−": "-", "–": "-", "—": "-", "·": "*",
    "×": "x", "≤": "<=", "≥": ">=", "≈": "~", "≠": "!=", "√": "sqrt", "∞": "inf", "π": "pi", "σ": "sigma",
    "‘": "'", "’": "'", "“": '"', "”": '"', "█": "#", "▇": "#", "─": "-", "│": "|", "└": "`", "├": "|",
}  # fmt: skip
"""Texts for characters that an encoding lacks."""

_ERRORS = "kineverse-plain"


def escape_controls(text: str) -> str:
    r"""Return a text with control characters and changes of direction as ``\x1b`` and ``\u202e``."""
    return _UNSAFE.sub(lambda found: _escape(found[0]), text)


def _escape(character: str) -> str:
    number = ord(character)
    return f"\\x{number:02x}" if number < 256 else f"\\u{number:04x}"


def _replace(error: UnicodeError) -> tuple[str, int]:
    """Return a text for the characters that cannot be encoded, for :func:`codecs.register_error`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    texts = (_transliterate(c) for c in error.object[error.start : error.end])
    return "".join(texts), error.end


def _transliterate(character: str) -> str:
    if character in _PLAIN:
        return _PLAIN[character]
    plain = unicodedata.normalize("NFKD", character)
    kept = "".join(c for c in plain if c.isascii())
    return kept or "?"


codecs.register_error(_ERRORS, _replace)


class _SafeStream:
    """A text stream that escapes control characters; what else it is asked for, the inner one answers."""

    def __init__(self, inner: TextIO, lenient: bool) -> None:
        self._inner, self._lenient = inner, lenient

    def write(self, text: str) -> int:
        """Write a text; if lenient, failures are ignored."""
        if _UNSAFE.search(text):
            parts = _OWN.split(text) if self._inner.isatty() else [text]
            text = "".join(p if k % 2 else escape_controls(p) for k, p in enumerate(parts))
        with self._named_failures():
            self._inner.write(text)
        return len(text)

    def flush(self) -> None:
        """Write what is buffered; if lenient, failures are ignored."""
        with self._named_failures():
            self._inner.flush()

    @contextlib.contextmanager
    def _named_failures(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            if not self._lenient:
                raise
        except OSError as error:
            if not self._lenient:
                raise OSError(error.errno, error.strerror, "standard output") from None

    def writelines(self, lines: Any) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def unwrap_stream(stream: TextIO) -> TextIO:
    """Return the stream itself, for what moves the cursor."""
    return stream._inner if isinstance(stream, _SafeStream) else stream


@contextlib.contextmanager
def safe_streams() -> Iterator[None]:
    """Let standard output and standard error escape control characters, and replace what they cannot encode."""
    out, err = sys.stdout, sys.stderr
    if out is None or err is None:
        _fill_descriptors()
    if err is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    if out is None:
        raise FormatError("Standard output is closed. Redirect it to /dev/null if it is not wanted.")
    with contextlib.ExitStack() as stack:
        for name, stream in (("stdout", out), ("stderr", sys.stderr)):
            if hasattr(stream, "reconfigure"):
                stack.callback(stream.reconfigure, errors=stream.errors)
                stream.reconfigure(errors=_ERRORS)
            stack.callback(setattr, sys, name, stream)
            setattr(sys, name, _SafeStream(stream, lenient=name == "stderr"))
        yield


def _fill_descriptors() -> None:
    """Open the null device in place of closed standard streams, so that no file takes their numbers."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
