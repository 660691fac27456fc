"""Pages of the site from those of the repository: sections, links and scripts."""

from __future__ import annotations

import ast
import posixpath
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

from website.names import ROOT

INDEX = "docs/README.md"
LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")
_CODE = re.compile(r"^```.*?^```$|`[^`\n]+`", re.MULTILINE | re.DOTALL)
_PLACES = {
    INDEX: "index",
    "README.md": "tour",
    "CONTRIBUTING.md": "contributing",
    "CHANGELOG.md": "changelog",
    "examples/README.md": "examples/index",
}


@dataclass(frozen=True)
class Section:
    """A section of the sidebar: its caption, and the titles and files of its pages."""

    caption: str
    pages: tuple[tuple[str, str], ...]


@cache
def find_documents() -> dict[str, str]:
    """Return the place in the site, without suffix, of each file of the repository that is a page of it."""
    places = dict(_PLACES)
    for path in sorted((ROOT / "docs").glob("*.md")):
        places.setdefault(f"docs/{path.name}", path.stem)
    for path in sorted((ROOT / "examples").rglob("*.py")):
        file = path.relative_to(ROOT).with_suffix("").as_posix()
        if (path.parent / "__main__.py").exists():
            file = posixpath.dirname(file)  # a program of several modules is one page
            places[file] = file
        else:
            places[f"{file}.py"] = file
    for path in sorted((ROOT / "examples" / "notebooks").glob("*.ipynb")):
        file = path.relative_to(ROOT).as_posix()
        places[file] = file.removesuffix(".ipynb")
    return places


def find_sections() -> tuple[Section, ...]:
    """Return the sections of the index, which are its tables, with the pages in their first columns."""
    text = (ROOT / INDEX).read_text(encoding="utf-8")
    sections = []
    for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        caption, _, body = part.partition("\n")
        rows = [line.split("|")[1] for line in body.splitlines() if line.startswith("|")]
        links = [link for row in rows for link in LINK.finditer(row)]
        if links:
            pages = tuple((link["text"], _locate(INDEX, link["target"])) for link in links)
            sections.append(Section(caption.strip(), pages))
    return tuple(sections)


def find_repository() -> str | None:
    """Return the address of the repository that the metadata name, if they do."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        urls = tomllib.load(file)["project"].get("urls", {})
    return next((urls[key].rstrip("/") for key in ("Repository", "Source") if key in urls), None)


def translate_link(file: str, target: str, repository: str | None) -> str | None:
    """Return where a link of a file leads in the site; None if to a file that is nowhere to be seen.

    Parameters
    ----------
    file
        The Markdown file that has the link, relative to the repository.
    target
        What stands between its brackets.
    repository
        Address of the repository on the web, if it has one.
    """
    if "://" in target or target.startswith(("#", "mailto:")):
        return target
    path, _, anchor = target.partition("#")
    found = _locate(file, path)
    documents = find_documents()
    here = posixpath.dirname(documents[file])
    anchor = f"#{anchor}" if anchor else ""
    if found in documents:
        return posixpath.relpath(f"{documents[found]}.md", here or ".") + anchor
    if found.startswith("docs/") and (ROOT / found).is_file():
        return posixpath.relpath(found.removeprefix("docs/"), here or ".")
    if repository:
        kind = "tree" if (ROOT / found).is_dir() else "blob"
        return f"{repository}/{kind}/main/{found}{anchor}"
    return None


def translate_page(file: str, repository: str | None) -> str:
    """Return a Markdown page with its links as the site needs them; those that lead nowhere become text."""
    return translate_links(file, (ROOT / file).read_text(encoding="utf-8"), repository)


def translate_links(file: str, text: str, repository: str | None) -> str:
    """Return the text of a file with its links as the site needs them; see :func:`translate_page`."""

    def replace(link: re.Match[str]) -> str:
        target = translate_link(file, link["target"], repository)
        label = link["text"]
        if target is None:
            return label if "\0" in label else f"`{label}`"
        if label == posixpath.basename(link["target"]) and label.endswith(".md"):
            label = read_title(_locate(file, link["target"]))
        return f"{link['image']}[{label}]({target})"

    return _outside_code(text, lambda part: LINK.sub(replace, part))


def read_title(file: str) -> str:
    """Return the title of a Markdown page."""
    return (ROOT / file).read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def _outside_code(text: str, change: Callable[[str], str]) -> str:
    """Change a page outside of its blocks of code; a link whose text is code is changed, too."""
    held: list[str] = []

    def hold(code: re.Match[str]) -> str:
        held.append(code[0])
        return f"\0{len(held) - 1}\0"

    changed = change(_CODE.sub(hold, text))
    return re.sub("\0(\\d+)\0", lambda number: held[int(number[1])], changed)


def _locate(file: str, target: str) -> str:
    """Return the path in the repository that a link of a file means."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(file), target.partition("#")[0]))


def list_toctrees(file: str) -> str:
    """Return the part of the site's tree that a page of the repository has, as hidden lists below it."""
    if file == INDEX:
        sections = find_sections()
    elif file == "examples/README.md":
        below = [one for one in find_documents() if one.startswith("examples/") and one != file]
        sections = (Section("", tuple((_name_example(one), one) for one in below)),)
    else:
        return ""
    return "".join(f"\n{one}\n" for one in map(_format_toctree, sections))


def _name_example(file: str) -> str:
    """Return a short title for the sidebar: that of a file, after the library that it comes from."""
    folder, _, name = file.removeprefix("examples/").rpartition("/")
    title = name.partition(".")[0].replace("_", " ")
    return f"{folder.removeprefix('from_')}: {title}" if folder.startswith("from_") else title


def _format_toctree(section: Section) -> str:
    documents = find_documents()
    entries = [f"{title} </{documents[file]}>" for title, file in section.pages if file in documents]
    if section.caption == "Reference":
        entries.insert(0, "Python API </api/index>")
    caption = [f":caption: {section.caption}"] if section.caption else []
    return "\n".join(["```{toctree}", ":hidden:", *caption, "", *entries, "```"])


def write_script(file: str, used: Iterator[str]) -> str:
    """Return the page of an example script, or of a folder of modules: what it shows, and its source.

    ``used`` are links to the reference of what it uses.
    """
    path = ROOT / file
    paths = sorted(path.glob("*.py"), key=lambda one: one.name != "__main__.py") if path.is_dir() else [path]
    first = paths[0].read_text(encoding="utf-8")
    title, _, rest = (ast.get_docstring(ast.parse(first)) or "").partition("\n")
    parts = [f"# {title.rstrip('.').replace('``', '`')}", rest.strip().replace("``", "`")]
    for one in paths:
        name = one.relative_to(ROOT).as_posix()
        parts += [f"`{name}`:", f"```python\n{one.read_text(encoding='utf-8').rstrip()}\n```"]
    if links := ", ".join(used):
        parts.append(f"Reference: {links}")
    return "\n\n".join(part for part in parts if part) + "\n"
