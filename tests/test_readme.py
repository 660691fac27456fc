"""The README: its tour is short, and it says what the package is called.

That the tour prints what is printed below it is tested with the other pages in ``test_docs``, and that its commands run in
``test_documented_commands``.
"""

from __future__ import annotations

import tomllib

from markdown_examples import ROOT, examples

README = ROOT / "README.md"


def test_the_tour_is_short_and_shows_something() -> None:
    tour = next(iter(examples(README)))
    lines = [line for line in tour.code.splitlines() if line.strip()]
    assert len(lines) < 30
    assert tour.output is not None
    assert len(tour.output.splitlines()) >= sum("print(" in line for line in lines)


def test_the_two_commands_are_targets_of_make() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    text = README.read_text(encoding="utf-8")
    for target in ("demo", "test"):
        assert f"make {target}" in text
        assert f"\n{target}:" in makefile


def test_the_names_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = README.read_text(encoding="utf-8")
    assert project["name"] in text
    for extra in project["optional-dependencies"]:
        assert f"`{extra}`" in text


def test_every_page_of_the_docs_is_listed() -> None:
    pages = {page.name for page in (ROOT / "docs").glob("*.md")} - {"README.md"}
    text, index = (
        README.read_text(encoding="utf-8"),
        (ROOT / "docs" / "README.md").read_text(encoding="utf-8"),
    )
    assert {name for name in pages if f"(docs/{name})" not in text} == set()
    assert {name for name in pages if f"]({name})" not in index} == set()
