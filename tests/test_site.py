"""The documentation site: where its pages come from. ``make docs`` builds it, and checks what was built."""

from __future__ import annotations

import importlib
import json
import re
from collections import Counter
from pathlib import Path

import pytest

from test_faces import find_faces

ROOT = Path(__file__).parents[1]

from website.check import find_problem  # noqa: E402  - it is no part of the package
from website.names import find_home, find_modules, find_names, find_pages  # noqa: E402
from website.pages import find_documents, find_sections, translate_link, translate_page  # noqa: E402
from website.uses import list_names  # noqa: E402

PAGES = [file for file in find_documents() if file.endswith(".md")]


def test_each_page_is_in_one_section() -> None:
    listed = Counter(file for section in find_sections() for _, file in section.pages)
    assert {file: listed[file] for file in PAGES if listed[file] != 1} == {"docs/README.md": 0}


def test_every_public_name_has_one_home() -> None:
    known = {path for one in find_names() for path in (one.home, *one.others)} | set(find_modules())
    for face, names in find_faces().items():
        assert {name for name, _ in names if f"{face}.{name}" not in known} == set(), face
    assert len({one.definition for one in find_names()}) == len(find_names()) > 450


@pytest.mark.parametrize("module", find_modules())
def test_public_names_are_those_of_the_modules(module: str) -> None:
    assert sorted(find_modules()[module]) == sorted(
        name for name in importlib.import_module(module).__all__ if name != "__version__"
    )


def test_paths_of_a_name_lead_to_one_object() -> None:
    for one in find_names():
        values = [_import(path) for path in (one.home, *one.others, one.definition)]
        assert all(value is values[0] for value in values), one


def _import(path: str) -> object:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def test_files_of_pages_differ_in_more_than_case() -> None:
    files = [page.lower() for page in {*find_pages().values()}]
    assert len(files) == len({*files})
    assert find_pages().keys() == {one.home for one in find_names()} | set(find_modules())


@pytest.mark.parametrize(
    ("path", "home"),
    [
        ("kineverse.model.model.Model.fk", "kineverse.Model.fk"),
        ("kineverse.model.Model", "kineverse.Model"),
        ("kineverse.lie", "kineverse.lie"),
        ("kineverse.lie.nonsense", None),
        ("numpy.array", None),
        ("", None),
    ],
)
def test_homes_are_found_from_other_paths(path: str, home: str | None) -> None:
    assert find_home(path) == home


@pytest.mark.parametrize(
    ("file", "target", "repository", "place"),
    [
        ("README.md", "docs/models.md#poses", None, "models.md#poses"),
        ("docs/models.md", "../README.md", None, "tour.md"),
        ("docs/models.md", "README.md", None, "index.md"),
        ("docs/models.md", "../examples/18_reach.py", None, "examples/18_reach.md"),
        ("docs/models.md", "../examples/living_kitchen", None, "examples/living_kitchen.md"),
        ("examples/README.md", "../docs/models.md", None, "../models.md"),
        ("examples/README.md", "from_pink/arm_ur5.py", None, "from_pink/arm_ur5.md"),
        ("README.md", "docs/pictures/ball.png", None, "pictures/ball.png"),
        ("docs/models.md", "https://example.org/a.md", None, "https://example.org/a.md"),
        ("docs/models.md", "#poses", None, "#poses"),
        ("README.md", "LICENSE", None, None),
        ("README.md", "LICENSE", "https://example.org/kv", "https://example.org/kv/blob/main/LICENSE"),
        (
            "docs/models.md",
            "../tools/fuzz",
            "https://example.org/kv",
            "https://example.org/kv/tree/main/tools/fuzz",
        ),
    ],
)
def test_links_lead_to_pages_or_to_the_repository(
    file: str, target: str, repository: str | None, place: str | None
) -> None:
    assert translate_link(file, target, repository) == place


def test_a_link_into_a_repository_without_an_address_is_plain_code() -> None:
    page = translate_page("README.md", None)
    assert "`Apache License 2.0`" in page
    assert "(LICENSE)" not in page


@pytest.mark.parametrize("file", PAGES)
def test_blocks_of_code_stay_as_they_are(file: str) -> None:
    def blocks(text: str) -> list[str]:
        return re.findall(r"^```.*?^```$", text, re.MULTILINE | re.DOTALL)

    text = (ROOT / file).read_text(encoding="utf-8")
    assert blocks(translate_page(file, "https://example.org")) == blocks(text)


def test_equations_of_the_pages_are_understood() -> None:
    pytest.importorskip("latex2mathml")
    from website.equations import to_mathml

    count = 0
    for file in PAGES:
        text = re.sub(
            r"^```.*?^```$|`[^`]*`", "", (ROOT / file).read_text(encoding="utf-8"), flags=re.M | re.S
        )
        for latex in re.findall(r"\$\$(.*?)\$\$", text, re.DOTALL) + re.findall(r"(?<!\$)\$([^$]+)\$", text):
            count += 1
            assert to_mathml(latex, display=True).startswith("<math")
    assert count > 20


def test_names_are_found_in_code() -> None:
    code = (
        "import kineverse as kv\nimport numpy as np\nfrom kineverse.control import Goal as G\n"
        "np.load(kv.model.Pose.from_matrix(kv.lie.inverse(x)))\nkv.errors\nmodel.fk('kv.load')\n"
    )
    assert {*list_names(code)} == {"kineverse.control.Goal", "kineverse.model.Pose", "kineverse.lie.inverse"}


@pytest.mark.parametrize(
    ("tag", "target", "problem"),
    [
        ("<a ", "b.html#there", None),
        ("<a ", "b.html#nowhere", "there is no b.html#nowhere"),
        ("<a ", "c.html", "there is no c.html"),
        ("<a ", "../index.html", None),
        ("<a ", "https://example.org", None),
        ("<script ", "https://example.org/a.js", "it fetches https://example.org/a.js"),
        ("<img ", "//example.org/a.png", "it fetches //example.org/a.png"),
        ("<img ", "data:image/png;base64,", None),
    ],
)
def test_problems_of_built_pages_are_found(tag: str, target: str, problem: str | None) -> None:
    files, anchors = {"index.html", "api/a.html", "api/b.html"}, {"api/b.html": {"there"}}
    assert find_problem("api/a.html", tag, target, files, anchors) == problem


def test_notebooks_are_pages_with_what_they_showed(tmp_path: Path) -> None:
    pytest.importorskip("latex2mathml")
    from website.notebooks import write_notebook

    def code(source: str, **data: object) -> dict[str, object]:
        return {
            "cell_type": "code",
            "source": [source],
            "outputs": [{"output_type": "execute_result", "data": data}],
        }

    cells = [
        {"cell_type": "markdown", "source": ["# A title\n", "and text"]},
        code("x", **{"text/latex": [r"$\displaystyle \frac{a}{b}$"], "text/plain": ["a/b"]}),
        code("y", **{"text/latex": [r"$\unheard{a}$"], "text/plain": ["a ``` b"]}),
        code("z", **{"image/png": "aGVsbG8=", "text/plain": ["a picture"]}),
        code("h", **{"text/html": ["<b>rich</b>"], "text/plain": ["plain"]}),
        {
            "cell_type": "code",
            "source": ["print(1)"],
            "outputs": [{"output_type": "stream", "text": ["1\n"]}],
        },
    ]
    path = tmp_path / "first.ipynb"
    path.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    page, pictures = write_notebook(path)
    assert page == (
        "# A title\nand text\n\n```python\nx\n```\n\n$$\n\\frac{a}{b}\n$$\n\n```python\ny\n```\n\n"
        "````text\na ``` b\n````\n\n```python\nz\n```\n\n![](first_1.png)\n\n```python\nh\n```\n\n"
        "```{raw} html\n<b>rich</b>\n```\n\n```python\nprint(1)\n```\n\n```text\n1\n```\n"
    )
    assert pictures == {"first_1.png": b"hello"}
