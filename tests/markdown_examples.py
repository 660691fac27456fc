"""The examples in Markdown files: taken out, run, and held against the output that is printed below them.

It needs nothing but Python, as a release is tried by it where there is no pytest.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).parents[1]

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.\d*(?:e[-+]?\d+)?")
_FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass(frozen=True)
class Example:
    """A block of code, and the ``text`` block right below it if there is one."""

    file: Path
    line: int
    code: str
    output: str | None


def examples(file: Path, language: str = "python") -> Iterator[Example]:
    """Yield the examples of a file in their order."""
    text = file.read_text(encoding="utf-8")
    blocks = list(_BLOCK.finditer(text))
    for block, following in zip_longest(blocks, blocks[1:]):
        if block[1] != language:
            continue
        below = (
            following is not None
            and following[1] == "text"
            and not text[block.end() : following.start()].strip()
        )
        output = following[2] if following is not None and below else None
        yield Example(file, text.count("\n", 0, block.start()) + 1, block[2], output)


def run(file: Path) -> None:
    """Run the examples of a file one after the other, like the cells of a notebook."""
    names: dict[str, object] = {"__name__": "example"}
    for example in examples(file):
        printed = io.StringIO()
        # The empty lines make a traceback show the line of the file.
        code = compile("\n" * example.line + example.code, str(example.file), "exec", dont_inherit=True)
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        if example.output is not None and not agree(example.output, printed.getvalue()):
            where = f"{example.file.relative_to(ROOT)}, line {example.line}"
            raise AssertionError(f"{where} says\n{example.output}\nbut it prints\n{printed.getvalue()}")


def agree(wanted: str, got: str, rel: float = 1e-6) -> bool:
    """Compare without regard to white space and the last digits; ``...`` stands for anything."""
    if doctest.OutputChecker().check_output(wanted, got, _FLAGS):
        return True
    if _words(wanted) != _words(got):
        return False
    pairs = zip(_NUMBER.findall(wanted), _NUMBER.findall(got), strict=True)
    return all(math.isclose(float(a), float(b), rel_tol=rel, abs_tol=1e-3 * rel) for a, b in pairs)


def _words(text: str) -> str:
    return "".join(_NUMBER.sub("#", text).split())
