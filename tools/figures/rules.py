"""Rules by which a cell of a page agrees with that of a short form of its command.

The short form has fewer samples, so it differs by its sampling error. Four standard errors are allowed, which
a normal distribution exceeds once in 16 000 times, and half a unit of the last digit that is printed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from .pages import Table

Row = Mapping[str, str]

ERRORS = 4.0
"""Number of standard errors that are allowed."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?")


class Rule(Protocol):
    """Rule of a column."""

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Return whether a cell agrees, given the rows of the page and of the short form."""
        ...


@dataclass(frozen=True)
class Same:
    """The same text, as for results that do not depend on the number of samples."""

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare the texts."""
        return said[column] == found[column]


class Key(Same):
    """A cell that names the row."""


@dataclass(frozen=True)
class Unchecked:
    """A cell that is not compared, with the reason."""

    reason: str

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare nothing."""
        return True


TIME = Unchecked("times depend on the machine and on what else it does")
EXTREME = Unchecked("the largest of few samples says little about the largest of many")


@dataclass(frozen=True)
class Mean:
    """A mean or root mean square of independent samples.

    Attributes
    ----------
    spread
        Standard deviation of a sample over the mean.
    samples
        Number of independent samples in the short form.
    """

    spread: float
    samples: int

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare within the standard error of the short form."""
        if not (has_number(said[column]) and has_number(found[column])):
            return said[column] == found[column]
        right = number(said[column])
        margin = ERRORS * self.spread * abs(right) / math.sqrt(self.samples)
        return abs(number(found[column]) - right) <= margin + rounding(said[column]) + rounding(found[column])


@dataclass(frozen=True)
class Share:
    """A share of cases [%], or of ``whole``.

    Attributes
    ----------
    samples
        Number of cases in the short form; ``"90.0 of 20"`` has its own.
    whole
        Share of all.
    is_part
        True if the short form has some of the cases of the page: none of all are none of some.
    """

    samples: int
    whole: float = 100.0
    is_part: bool = False

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare within the standard error of a binomial distribution."""
        if not (has_number(said[column]) and has_number(found[column])):
            return True  # without samples there is no share
        right = number(said[column]) / self.whole
        if self.is_part and right in (0.0, 1.0):
            return number(found[column]) / self.whole == right
        count = int(numbers(found[column])[1]) if " of " in found[column] else self.samples
        # A share of 0 or 1 of n samples may be one that is 1/n off.
        spread = math.sqrt(max(right * (1 - right), 1 / count) / count)
        return abs(number(found[column]) / self.whole - right) <= ERRORS * spread


@dataclass(frozen=True)
class Count:
    """A number of cases of which the short form has some: it counts no more of them.

    Attributes
    ----------
    of
        Column with the number of all cases; the cases that are not counted are compared as well.
    """

    of: str = ""

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare the cases that count, and those that do not."""
        most, part = number(said[column] or "0"), number(found[column] or "0")
        if self.of and number(found[self.of]) - part > number(said[self.of]) - most:
            return False
        return part <= most


class CountOf:
    """``"3 of 4"``: a number of cases, and that of all; the short form has some of them."""

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare the cases that count, and those that do not."""
        (most, all_cases), (part, some) = numbers(said[column])[:2], numbers(found[column])[:2]
        return part <= most and some - part <= all_cases - most


@dataclass(frozen=True)
class ByRow:
    """Another rule for each text in another column.

    Attributes
    ----------
    column
        The other column.
    rules
        Rules by the beginning of its text; that of ``""`` is for all others.
    """

    column: str
    rules: Mapping[str, Rule]

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare by the rule of the row."""
        fitting = [start for start in self.rules if said[self.column].startswith(start)]
        return self.rules[max(fitting, key=len)].agree(column, said, found)


@dataclass(frozen=True)
class Largest:
    """The largest value over cases of which the short form has some.

    Attributes
    ----------
    least
        Values up to here are rounding errors, which differ between machines.
    """

    least: float = 0.0

    def agree(self, column: str, said: Row, found: Row) -> bool:
        """Compare the largest of some with the largest of all."""
        if not has_number(found[column]) or number(found[column]) <= self.least:
            return True
        return has_number(said[column]) and number(found[column]) <= number(said[column]) + 2 * rounding(
            said[column]
        )


def numbers(text: str) -> list[float]:
    """Return all numbers in a cell."""
    return [float(one) for one in _NUMBER.findall(text)]


def has_number(text: str) -> bool:
    """Return whether a cell has a number."""
    return bool(_NUMBER.search(text))


def number(text: str) -> float:
    """Return the first number in a cell."""
    return numbers(text)[0]


def rounding(text: str) -> float:
    """Return half a unit of the last digit of the first number in a cell."""
    found = _NUMBER.search(text)
    mantissa, _, exponent = (found[0] if found else "").partition("e")
    return 0.5 * 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def find_disagreements(
    said: Table, found: Table, rules: Mapping[str, Rule], has_all_rows: bool = True
) -> list[str]:
    """Return a line for each cell of the short form with which the page disagrees.

    Parameters
    ----------
    said, found
        Tables of the page and of the short form; each column of the page has a rule.
    rules
        Rules by column.
    has_all_rows
        True if the short form has all rows of the page, False if it has some of them.
    """
    wrong = [f"column '{column}' has no rule" for column in said.head if column not in rules]
    wrong += [
        f"no column '{column}' in what the command prints" for column in said.head if column not in found.head
    ]
    if wrong:
        return wrong
    names = [column for column in said.head if isinstance(rules[column], Key)]
    rows = {}
    for cells in said.rows:
        row = dict(zip(said.head, cells, strict=True))
        rows[tuple(row[name] for name in names)] = row
    chosen = found.chosen(said.head).rows
    if not chosen or (has_all_rows and len(chosen) != len(rows)):
        wrong.append(f"the short form has {len(chosen)} rows, the page {len(rows)}")
    for cells in chosen:
        row = dict(zip(said.head, cells, strict=True))
        key = tuple(row[name] for name in names)
        if key not in rows:
            wrong.append(f"the row {key} is not on the page")
            continue
        wrong += [
            f"{' '.join(key)}: {column} is {row[column]} in the short form, {rows[key][column]} on the page"
            for column in said.head
            if not rules[column].agree(column, rows[key], row)
        ]
    return wrong
