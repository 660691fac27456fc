"""Build the documentation site: ``python tools/website`` writes build/site.

Pages, examples and the reference are written to build/site-source first. Warnings are errors. Then the
inventory must have all public names, links must lead somewhere, and nothing may be fetched from elsewhere.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from sphinx.cmd.build import build_main

from website.check import check_site
from website.names import ROOT
from website.notebooks import write_notebook
from website.pages import (
    find_documents,
    find_repository,
    list_toctrees,
    translate_links,
    translate_page,
    write_script,
)
from website.reference import link_names, write_reference
from website.uses import find_uses


def write_sources(folder: Path) -> None:
    """Write all pages to a folder; those that have not changed stay, and Sphinx need not read them again."""
    for place, content in _list_sources():
        path = folder / place
        if not path.exists() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


def _list_sources() -> Iterator[tuple[str, bytes]]:
    repository = find_repository()
    for file, place in find_documents().items():
        if file.endswith(".ipynb"):
            text, pictures = write_notebook(ROOT / file)
            for name, picture in pictures.items():
                yield f"{Path(place).parent}/{name}", picture
            text = translate_links(file, text, repository)
        elif file.endswith(".md"):
            text = translate_page(file, repository) + list_toctrees(file)
        else:
            text = write_script(file, link_names(file, find_uses()[file]))
        yield f"{place}.md", text.encode()
    for place, text in write_reference():
        yield f"{place}.rst", text.encode()
    for path in sorted((ROOT / "docs" / "pictures").iterdir()):
        yield f"pictures/{path.name}", path.read_bytes()


def main() -> int:
    """Write, build, check."""
    parser = argparse.ArgumentParser(
        prog="make docs", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--changed", action="store_true", help="build only pages that have changed")
    parser.add_argument("--jobs", default="auto", help="processes (one for each core)")
    arguments = parser.parse_args()
    sources, doctrees, site = (ROOT / "build" / name for name in ("site-source", "site-doctrees", "site"))
    if not arguments.changed:
        for folder in (sources, doctrees, site):
            shutil.rmtree(folder, ignore_errors=True)
    write_sources(sources)
    words = ["-q", "-W", "--keep-going", "-b", "html", "-j", arguments.jobs, "-c", str(ROOT / "docs")]
    if build_main([*words, "-d", str(doctrees), str(sources), str(site)]):
        return 1
    problems = check_site(site)
    for problem in problems:
        sys.stderr.write(f"{problem}\n")
    if not problems:
        sys.stdout.write(f"{site.relative_to(ROOT)}/index.html\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
