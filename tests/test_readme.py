"""The README and the release notes: both are short, and they name the package and its version.

That the tour prints what is printed below it is tested with the other pages in ``test_docs``, and that its commands run in
``test_documented_commands``.
"""

from __future__ import annotations

import re
import tomllib

from kineverse._version import __version__
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
    assert project["name"] in README.read_text(encoding="utf-8")
    installation = (ROOT / "docs" / "installation.md").read_text(encoding="utf-8")
    for extra in project["optional-dependencies"]:
        assert f"`{extra}`" in installation
    for requirement in project["dependencies"]:
        assert requirement.partition(">")[0] in installation


def test_the_readme_is_short_and_leads_to_the_list_of_pages() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 130
    assert "(docs/README.md)" in text


def test_the_release_notes_are_short_and_of_this_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    assert f"## {__version__.rpartition('.')[0]}" in text


def test_the_figures_beside_peers_are_those_of_the_benchmarks() -> None:
    rows = re.findall(
        r"^\| .* \| (.* [nµm]s) \| (.*\d ×.*) \|$", README.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert rows
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    for time, others in rows:
        ours = re.findall(rf"^\| (.*) \| {re.escape(time)} \|", page, re.MULTILINE)
        assert ours, time
        for factor in re.findall(r"([\d.]+) ×", others):
            assert any(
                re.search(
                    rf"\| {re.escape(factor)} × {re.escape(name)}|; {re.escape(factor)} × {re.escape(name)}",
                    page,
                )
                for name in ours
            ), factor
