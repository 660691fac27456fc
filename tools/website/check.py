"""Check of a site that was built: all names, no link into nowhere, nothing from elsewhere."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

from website.names import find_names

_TAG = re.compile(r"<(?:a|link|script|img|source|iframe|video|object|use)\b[^>]*>")
_HREF = re.compile(r'\b(?:href|src|srcset|data|poster)="([^"]*)"')
_IDS = re.compile(r'\b(?:id|name)="([^"]+)"')
_FETCH = re.compile(r"""(?:url\(|@import)\s*['"]?((?:https?:)?//[^'")\s]+)""")


def check_site(site: Path) -> list[str]:
    """Return what is wrong, a line each."""
    return [*_list_missing_names(site), *_check_pages(site)]


def _list_missing_names(site: Path) -> Iterator[str]:
    from sphinx.util.inventory import InventoryFile  # which the tests do without

    inventory = InventoryFile.loads((site / "objects.inv").read_bytes(), uri="").data
    listed = {name for kind in inventory if kind.startswith("py:") for name in inventory[kind]}
    for one in find_names():
        if one.home not in listed:
            yield f"{one.home} has no page"


def _check_pages(site: Path) -> Iterator[str]:
    pages = {
        path.relative_to(site).as_posix(): path.read_text(encoding="utf-8") for path in site.rglob("*.html")
    }
    anchors = {page: set(_IDS.findall(text)) for page, text in pages.items()}
    files = {path.relative_to(site).as_posix() for path in site.rglob("*")}
    for page, text in pages.items():
        for tag in _TAG.findall(text):
            for target in _HREF.findall(tag):
                if problem := find_problem(page, tag, target, files, anchors):
                    yield f"{page}: {problem}"
    for path in site.rglob("*.css"):
        for address in _FETCH.findall(path.read_text(encoding="utf-8")):
            yield f"{path.relative_to(site)}: it fetches {address}"


def find_problem(
    page: str, tag: str, target: str, files: set[str], anchors: dict[str, set[str]]
) -> str | None:
    """Return what is wrong with where a tag of a page leads."""
    if re.match(r"(https?:)?//", target):
        return None if tag.startswith("<a ") else f"it fetches {target}"
    if re.match(r"[a-z]+:", target):
        return None
    path, _, anchor = target.partition("#")
    path = unquote(path.partition("?")[0])
    found = posixpath.normpath(posixpath.join(posixpath.dirname(page), path)) if path else page
    if found not in files:
        return f"there is no {target}"
    if anchor and found in anchors and unquote(anchor) not in anchors[found]:
        return f"there is no {target}"
    return None
