"""Tables in Markdown, and the marked ones on the pages."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

_MARKED = re.compile(r"^<!-- figures: ([\w-]+) -->\n(.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL)
_LINES = re.compile(r"(?:^\|.*\|\n)+", re.MULTILINE)
_BETWEEN_CELLS = re.compile(r"(?<!\\)\|")


@dataclass(frozen=True)
class Table:
    """Table of texts: its head, and rows of as many cells."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def chosen(self, columns: tuple[str, ...]) -> Table:
        """Return the table with some of its columns, in the order given; with all if none is given."""
        if not columns:
            return self
        kept = [self.head.index(column) for column in columns]
        return Table(columns, tuple(tuple(row[k] for k in kept) for row in self.rows))

    def __str__(self) -> str:
        lines = [self.head, ("---",) * len(self.head), *self.rows]
        return "".join(f"| {' | '.join(line)} |\n".replace("|  |", "| |") for line in lines)


@dataclass(frozen=True)
class Block:
    """Marked part of a page: what is between the marks."""

    name: str
    page: Path
    text: str

    @property
    def tables(self) -> list[Table]:
        """Tables in the block."""
        return list(find_tables(self.text))


def find_tables(text: str) -> Iterator[Table]:
    """Yield the tables of a text in Markdown."""
    for found in _LINES.finditer(text if text.endswith("\n") else text + "\n"):
        head, _, *rows = (
            tuple(cell.strip() for cell in _BETWEEN_CELLS.split(line)[1:-1])
            for line in found[0].strip().split("\n")
        )
        yield Table(head, tuple(rows))


def find_titled_tables(text: str) -> Iterator[tuple[str, Table]]:
    """Yield the tables that a command prints with ``--markdown``, each with the title above it."""
    for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        title, _, body = part.partition("\n")
        for table in find_tables(body):
            yield title, table


def pages() -> list[Path]:
    """Return all pages that may have figures."""
    return [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "examples" / "README.md",
        *sorted(DOCS.glob("*.md")),
    ]


def find_blocks(page: Path) -> list[Block]:
    """Return the marked parts of a page."""
    return [Block(m[1], page, m[2]) for m in _MARKED.finditer(page.read_text("utf-8"))]


def without_blocks(page: Path) -> str:
    """Return the text of a page without its marked parts."""
    return _MARKED.sub("", page.read_text("utf-8"))


def write_block(page: Path, name: str, text: str) -> None:
    """Replace the text of a marked part.

    Raises
    ------
    ValueError
        If the page has none of this name.
    """
    before = page.read_text("utf-8")
    if name not in {block.name for block in find_blocks(page)}:
        raise ValueError(
            f"{page.name} has no mark '<!-- figures: {name} -->' with an '<!-- end -->' below it"
        )
    marked = f"<!-- figures: {name} -->\n{text}<!-- end -->"
    page.write_text(_MARKED.sub(lambda m: marked if m[1] == name else m[0], before), "utf-8")
