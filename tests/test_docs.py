"""Every example in the documentation runs and prints what it says, and every link leads somewhere."""

from __future__ import annotations

import re
import tempfile
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest

from markdown_examples import ROOT, agree, examples, run

PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES += sorted((ROOT / "docs").glob("*.md"))

_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", [p for p in PAGES if any(examples(p))], ids=_name)
def test_the_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    with tempfile.TemporaryDirectory(prefix="kv-") as sockets:  # short, as paths of sockets have to be
        monkeypatch.setenv("KINEVERSE_RUNTIME_DIR", sockets)
        run(page)


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_within_the_repository_lead_somewhere(page: Path) -> None:
    for target in _LINK.findall(page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), f"{_name(page)} links to {target}"
        if anchor:
            assert anchor in _anchors(path), f"{_name(page)} links to {target}"


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=_name)
def test_the_index_names_every_page(page: Path) -> None:
    index = ROOT / "docs" / "README.md"
    assert page == index or f"({page.name})" in index.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_names_of_the_library_on_pages_exist(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    names = set(re.findall(r"`(?:kineverse|kv)((?:\.\w+)+)", text)) - {".commands", ".robots", ".NAME"}
    assert {name for name in names if not _exists(f"kineverse{name}")} == set()


def _exists(name: str) -> bool:
    """Return whether a dotted name is a module, or an attribute of one."""
    with suppress(ModuleNotFoundError):
        import_module(name)
        return True
    parent, _, attribute = name.rpartition(".")
    return bool(parent) and _exists(parent) and hasattr(_resolve(parent), attribute)


def _resolve(name: str) -> object:
    parent, _, attribute = name.rpartition(".")
    with suppress(ModuleNotFoundError):
        return import_module(name)
    return getattr(_resolve(parent), attribute)


def _anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


@pytest.mark.parametrize(
    ("wanted", "got", "same"),
    [
        ("[0.1 2.0]", "[0.1  2.0]\n", True),
        ("[0.1]", "[0.10000000001]", True),
        ("[0.1]", "[0.11]", False),
        ("3 frames", "4 frames", False),
        ("a ... c", "a b c", True),
        ("a", "b", False),
    ],
)
def test_outputs_are_compared_up_to_the_last_digits(wanted: str, got: str, same: bool) -> None:
    assert agree(wanted, got) is same
