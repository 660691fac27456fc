"""Run the Python of pages in this environment, and compare what it prints: ``run_pages.py PAGE ...``.

A folder stands for its pages. A page may stop where an extra is missing, if it names this extra. With
``--whole`` it may not.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
import tempfile
import tomllib
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "tests"), str(ROOT / "examples")]  # as the tests of the pages have it

import markdown_examples  # noqa: E402  - of the tests

BESIDE = {"kineverse_studies": "studies"}
"""The packages that are in no extra, and the words by which pages name them."""


def main(words: list[str]) -> int:
    """Run all pages, and return 1 if one is wrong."""
    whole = "--whole" in words
    paths = [ROOT / word for word in words if word != "--whole"]
    pages = [page for path in paths for page in (sorted(path.glob("*.md")) if path.is_dir() else [path])]
    wrong = [f"{page.relative_to(ROOT)}: {reason}" for page in pages if (reason := run(page, whole))]
    print(f"        {len(pages) - len(wrong)} of {len(pages)} pages")
    print("\n".join(wrong), file=sys.stderr)
    return int(bool(wrong))


def run(page: Path, whole: bool) -> str | None:
    """Return what is wrong with a page; None if nothing is."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name in ("docs", "examples"):
            Path(name).symlink_to(ROOT / name)
        try:
            with contextlib.redirect_stderr(io.StringIO()):
                markdown_examples.run(page)
        except ImportError as error:
            missing = _find_missing(error)
            text = page.read_text("utf-8")
            named = [
                name
                for name in missing
                if re.search(rf"extras?\b[^.|]*`{name}`|\[[\w,]*\b{name}\b[\w,]*\]", text)
            ]
            beside = BESIDE.get(error.name or "")
            if whole or not (named or (beside and beside in text)):
                return f"lacks {' or '.join(missing) or error.name}, which it does not name ({error})"
        except Exception as error:
            return f"{type(error).__name__}: {error}"
    return None


def _find_missing(error: ImportError) -> list[str]:
    """Return the extras that an error tells to install, or whose module is missing."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    if error.name:
        return [
            extra for extra, lines in extras.items() if any(line.startswith(error.name) for line in lines)
        ]
    told = set(re.findall(r"'([^']+[<>=][^']+)'", str(error)))
    return [extra for extra, lines in extras.items() if extra != "all" and {*lines} <= told]


if __name__ == "__main__":
    assert find_spec("kineverse"), "Kineverse is not installed here."
    sys.exit(main(sys.argv[1:]))
