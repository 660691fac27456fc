"""Terminal output: streams that are safe for terminals, colours, plain text tables, progress."""

from __future__ import annotations

import argparse
import codecs
import contextlib
import os
import re
import shutil
import sys
import unicodedata
from collections.abc import Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, TextIO, TypeVar

from kineverse.errors import FormatError

if TYPE_CHECKING:
    from rich.console import Console

    from kineverse.model.model_view import ModelView

# Control characters other than tab and line feed, and those that turn the direction of writing.
_UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
# What this program itself writes to terminals: colours, and the end of a line.
_OWN = re.compile("(\033\\[[0-9;]{1,8}m|\r\033\\[K)")

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
    characters = error.object[error.start : error.end]
    return "".join(_PLAIN.get(c) or _keep_ascii(c) or "?" for c in characters), error.end


def _keep_ascii(character: str) -> str:
    return "".join(c for c in unicodedata.normalize("NFKD", character) if c.isascii())


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
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def unwrap_stream(stream: TextIO) -> TextIO:
    """Return the stream itself, for what moves the cursor."""
    return stream._inner if isinstance(stream, _SafeStream) else stream


@contextlib.contextmanager
def safe_streams() -> Iterator[None]:
    """Let standard output and error escape control characters, and replace what they cannot encode."""
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


_STYLES = {"+": "green", "-": "red", "~": "yellow", ">": "cyan", "!": "red", "bold": "bold"}


def _find_console(stream: TextIO) -> Console | None:
    """Return rich's console for a terminal; None for a pipe or a file, where everything is plain text."""
    if not stream.isatty():
        return None
    from rich.console import Console  # for start-up time: most output goes to pipes and small screens

    console = Console(file=unwrap_stream(stream), highlight=False, markup=False, emoji=False)
    return None if console.no_color or console.is_dumb_terminal else console


def colorize(text: str, style: str) -> str:
    """Return a text in the colour of a sign (``+``, ``-``, ``~``, ``>``, ``!``), or ``bold``.

    The text stays plain if standard output is not a terminal, or the environment has ``NO_COLOR``.
    """
    console = _find_console(sys.stdout) if text else None
    if console is None:
        return text
    with console.capture() as captured:
        console.out(text, style=_STYLES[style], end="")
    return captured.get()


def truncate_lines(lines: Sequence[str], most: int | None, indent: str = "  ") -> list[str]:
    """Return the first ``most`` lines and the number of others; all lines if ``most`` is None."""
    if most is None or len(lines) <= most:
        return list(lines)
    return [*lines[:most], f"{indent}… and {len(lines) - most} more (--all)"]


# Names from files may have line feeds; a row is one line.
_NO_LINES = str.maketrans({"\n": "\\n", "\r": "\\r", "\t": "\\t"})

Align = Literal["<", ">"]


def format_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], align: str = "", width: int | None = None
) -> str:
    """Return rows of cells as lines with aligned columns."""
    cells = [list(head), *([cell.translate(_NO_LINES) for cell in row] for row in rows)]
    sides: list[str] = [align[k] if k < len(align) else "<" for k in range(len(head))]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    available = (terminal_width() if width is None else width) - sum(widths[1:]) - 2 * (len(head) - 1)
    if widths and widths[0] > available:
        widths[0] = max(available, 12)
    for row in cells:
        row[0] = shorten_text(row[0], widths[0])
    console = _find_console(sys.stdout) if width is None else None
    if console is not None:
        return _render_table(console, cells, sides)
    lines = [
        "  ".join(f"{cell:{side}{w}}" for cell, side, w in zip(row, sides, widths, strict=True)).rstrip()
        for row in cells
    ]
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(lines)


def _render_table(console: Console, cells: Sequence[Sequence[str]], sides: Sequence[str]) -> str:
    """Return a table for a terminal, whose long cells go on in the next line."""
    from rich.box import SIMPLE_HEAD  # for start-up time
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, header_style="bold")
    for k, (title, side) in enumerate(zip(cells[0], sides, strict=True)):
        table.add_column(
            Text(title), justify="right" if side == ">" else "left", no_wrap=k == 0, overflow="fold"
        )
    for row in cells[1:]:
        table.add_row(*(Text(escape_controls(cell)) for cell in row))
    with console.capture() as captured:
        console.print(table)
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def format_markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return rows of cells as a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in lines)


def format_bytes(size: int) -> str:
    """Return a size with its unit: ``"45 MiB"``."""
    for unit, factor in (("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)):
        if size >= factor:
            return f"{size / factor:.4g} {unit}" if size >= 1000 * factor else f"{size / factor:.3g} {unit}"
    return f"{size} B"


def format_cells(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of names and, aligned to the right, of what is known about them."""
    return format_table(head, rows, "<" + ">" * (len(head) - 1))


def count_contents(model: ModelView) -> dict[str, int]:
    """Return the numbers of frames, degrees of freedom and constraints of a model."""
    counted = {"frames": model.frames, "dof": model.degrees_of_freedom, "constraints": model.constraints}
    return {kind: len(items) for kind, items in counted.items()}


def format_contents(model: ModelView) -> str:
    """Return the numbers of frames, degrees of freedom and constraints of a model as text."""
    numbers = zip(count_contents(model).values(), ("frame", "DoF", "constraint"), strict=True)
    return ", ".join(format_count(count, noun) for count, noun in numbers)


def format_count(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is 1."""
    if count != 1 and noun != "DoF":
        noun = f"{noun[:-1]}ies" if noun.endswith("dy") else f"{noun}s"
    return f"{count} {noun}"


def join_lines(message: object) -> str:
    """Return a message, such as an exception, on one line."""
    return " ".join(str(message).split())


def name_options(text: str, arguments: argparse.Namespace) -> str:
    """Return a message of the library with options of the command in place of arguments: ``--seconds``."""
    parser: argparse.ArgumentParser = arguments.command
    options = {one[2:].replace("-", "_"): one for one in parser._option_string_actions if one[:2] == "--"}
    return re.sub(r"\b([a-z_]+)=(?![\w'\"({\[<])", lambda found: options.get(found[1], found[0]), text)


def shorten_text(text: str, width: int) -> str:
    """Return a text cut in its middle to a width."""
    if len(text) <= width:
        return text
    left = (width - 3) // 2
    return f"{text[:left]}...{text[len(text) - (width - 3 - left) :]}"


def terminal_width() -> int:
    """Return the columns of the terminal; 10 000 if standard output is not a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 10_000


Item = TypeVar("Item")


def show_progress(
    items: Iterable[Item], what: str, unit: str = "", total: int | None = None
) -> Iterator[Item]:
    """Yield the items, with a bar on standard error if that is a terminal."""
    console = _find_console(sys.stderr)
    if console is None:
        yield from items
        return
    # For start-up time.
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{unit}s" if unit else ""),
        TimeRemainingColumn(),
    )
    if isinstance(items, Sized):
        total = len(items)
    with Progress(
        *columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False
    ) as progress:
        yield from progress.track(items, total, description=what)


@contextmanager
def show_activity(what: str) -> Iterator[None]:
    """Print an activity on standard error while it lasts, if that is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    print(f"{what} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def print_line(text: str) -> None:
    """Print a line on standard error, in the place of an activity that is shown there."""
    clear = "\r\033[K" if sys.stderr.isatty() else ""
    print(f"{clear}{text}", file=sys.stderr, flush=True)
