"""Every table of figures in the docs is made by a command, and a short form of the command agrees with it.

``tools/figures`` lists the tables: ``python tools/figures --write NAME`` writes one anew. The rows of benchmarks
are compared in ``tests/bench``.
"""

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

from figures.documented import DOCUMENTED  # noqa: E402  - it is no part of the package
from figures.pages import DOCS, Table, find_blocks, find_tables, pages, without_blocks, write_block  # noqa: E402
from figures.rules import (  # noqa: E402
    ByRow,
    Count,
    CountOf,
    Key,
    Largest,
    Mean,
    Same,
    Share,
    Unchecked,
    find_disagreements,
)
from figures.short_forms import has_data  # noqa: E402
from figures.writing import find_table, write_printed  # noqa: E402

BLOCKS = {block.name: block for page in pages() for block in find_blocks(page)}

STATED = {
    "documents.md: limit",  # of what is read
    "files.md: ",  # exit statuses
    "identification.md: family",  # numbers of joint values, and prior probabilities
    "conventions.md: ",
    "README.md: work",  # some of those of benchmarks.md, as test_readme holds
    "release.md: extra",  # versions of Python, by tools/dependencies.py, which asks the package index
}
"""Tables of numbers that nobody measured: page, and title of the first column."""

SLOW = {"stream-monitoring", "costs"}
"""Tables whose short form takes more than 5 s of a quiet machine."""


def _name(one):
    return one.name


@pytest.mark.parametrize(
    "one",
    [
        pytest.param(
            one,
            marks=pytest.mark.data if one.data else pytest.mark.long if one.name in SLOW else (),
            id=_name(one),
        )
        for one in DOCUMENTED
        if one.short
    ],
)
def test_a_short_form_of_the_command_agrees_with_the_page(one):
    if one.data and not has_data(one.data):
        pytest.skip(f"no {one.data} in KINEVERSE_TEST_DATA")
    assert one.short is not None
    (said,) = BLOCKS[one.name].tables
    found = next(table for title, table in one.short() if title.startswith(one.title))
    assert find_disagreements(said, found, one.rules, one.has_all_rows) == []


def test_each_table_has_one_place_and_each_mark_a_table():
    marks = Counter((block.page.name, block.name) for page in pages() for block in find_blocks(page))
    assert marks == Counter((one.page, one.name) for one in DOCUMENTED)


@pytest.mark.parametrize("one", DOCUMENTED, ids=_name)
def test_a_page_has_the_columns_of_the_command_and_names_it(one):
    block = BLOCKS[one.name]
    (table,) = block.tables
    assert table.head == one.columns
    assert table.rows
    assert re.search(rf"\n`{re.escape(one.command)}`, \d+ [A-Z][a-z]+ \d{{4}}\n\Z", block.text)


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_tables_of_numbers_are_made_by_a_command(page):
    """Look for tables without marks of which most cells are numbers with or without a unit."""
    number = re.compile(
        r"[-+±≥≤<>]?\s*[\d.,]+(e-?\d+)?( ?[×%°a-zµ/²³]{1,6})?([ ,…/-]+[\d.,]+( ?[×%°a-zµ/]{1,6})?)*"
    )
    for table in find_tables(re.sub(r"```.*?```", "", without_blocks(page), flags=re.DOTALL)):
        cells = [cell for row in table.rows for cell in row[1:] if cell]
        share = sum(bool(number.fullmatch(cell)) for cell in cells) / max(1, len(cells))
        assert share < 0.5 or f"{page.name}: {table.head[0]}" in STATED, table.head


# Rules


@pytest.mark.parametrize(
    ("rule", "said", "found", "agrees"),
    [
        (Same(), "yes", "no", False),
        (Mean(1.0, 400), "0.0055", "0.0064", True),
        (Mean(1.0, 400), "0.0055", "0.0128", False),
        (Mean(1.0, 400), "1.00", "0.60", False),
        (Mean(1.0, 400), "-", "-", True),
        (Mean(1.0, 400), "-", "1", False),
        (Share(25), "96 %", "84", True),
        (Share(25), "96 %", "40", False),
        (Share(25, is_part=True), "0", "4", False),
        (Share(25), "90.0 of 300 (0)", "50.0 of 2 (0)", True),
        (Share(25), "90.0 of 300 (0)", "10.0 of 30 (0)", False),
        (Count(), "3", "3", True),
        (Count(), "3", "4", False),
        (CountOf(), "10 of 10", "1 of 1", True),
        (CountOf(), "10 of 10", "0 of 1", False),
        (CountOf(), "0 of 10", "1 of 1", False),
        (Largest(), "0.36", "0.363", True),
        (Largest(), "0.36", "0.38", False),
        (Largest(), "", "0.1", False),
        (Largest(least=1e-9), "1e-15", "1e-12", True),
        (Unchecked("time"), "1", "2", True),
    ],
)
def test_rules_tell_errors_of_sampling_from_others(rule, said, found, agrees):
    assert rule.agree("x", {"x": said}, {"x": found}) is agrees


def test_cases_that_do_not_count_are_compared_as_well():
    rule, said = Count(of="all"), {"done": "9", "all": "10"}
    assert rule.agree("done", said, {"done": "0", "all": "1"})
    assert not rule.agree("done", said, {"done": "0", "all": "2"})


def test_a_rule_may_differ_from_row_to_row():
    rule = ByRow("who", {"": Same(), "ours": Mean(1.0, 4)})
    assert rule.agree("x", {"who": "ours, too", "x": "1"}, {"who": "ours, too", "x": "2"})
    assert not rule.agree("x", {"who": "theirs", "x": "1"}, {"who": "theirs", "x": "2"})


def test_rows_and_columns_that_the_page_lacks_are_disagreements():
    said = Table(("who", "x"), (("a", "1"), ("b", "2")))
    rules = {"who": Key(), "x": Same()}
    assert find_disagreements(said, said, rules) == []
    some = Table(("x", "who"), (("1", "a"),))
    assert find_disagreements(said, some, rules, has_all_rows=False) == []
    assert find_disagreements(said, some, rules) == ["the short form has 1 rows, the page 2"]
    assert "('c',)" in find_disagreements(said, Table(("who", "x"), (("c", "1"),)), rules, False)[0]
    assert "has no rule" in find_disagreements(said, said, {"who": Key()})[0]
    assert "b: x is 3" in find_disagreements(said, Table(("who", "x"), (("a", "1"), ("b", "3"))), rules)[0]


# Writing


def test_what_a_command_prints_is_written_between_the_marks(tmp_path, monkeypatch):
    one = next(one for one in DOCUMENTED if one.name == "sturm-missed")
    page = tmp_path / one.page
    page.write_text("before\n<!-- figures: sturm-missed -->\nold\n<!-- end -->\nafter\n", "utf-8")
    monkeypatch.setattr("figures.writing.DOCS", tmp_path)
    printed = "# T\n\n## Missed\n\n| recording | shows | all |\n| --- | --- | --- |\n| a \\| b | door | |\n"
    write_printed(printed, [one])
    text = page.read_text("utf-8")
    assert text.startswith("before\n<!-- figures: sturm-missed -->\n| recording | shows |\n")
    assert text.endswith("<!-- end -->\nafter\n")
    (block,) = find_blocks(page)
    assert block.tables == [Table(("recording", "shows"), (("a \\| b", "door"),))]
    assert f"\n`{one.command}`, " in block.text
    with pytest.raises(ValueError, match="no mark"):
        write_block(page, "another", "")
    with pytest.raises(ValueError, match="no table 'Missed'"):
        find_table("## Other\n\n| a |\n| --- |\n| 1 |\n", one)


def test_all_pages_are_looked_at():
    assert {page.name for page in pages() if page.parent == DOCS} == {page.name for page in DOCS.glob("*.md")}
