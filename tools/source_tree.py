"""Draw the tree of the package for docs/architecture.md.

python tools/source_tree.py            print it
python tools/source_tree.py --write    put it into the page
"""

import ast
import re
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROS = ROOT / "ros" / "kineverse_ros" / "kineverse_ros"
PAGE = ROOT / "docs" / "architecture.md"
BLOCK = re.compile(r"(?<=## Source tree\n\n```text\n).*?(?=```\n)", re.DOTALL)
WIDTH = 118


def tree() -> str:
    """Return one paragraph for each folder: its name, its subject, and its modules or files of C."""
    return _draw(ROOT / "src" / "kineverse") + _draw(ROOT / "studies" / "kineverse_studies") + _draw(ROS)


def _draw(source: Path) -> str:
    lines: list[str] = []
    files = (p for p in source.rglob("*") if p.name == "__init__.py" or p.suffix in (".c", ".h"))
    folders = sorted({source, *(p.parent for p in files)})
    for folder in folders:
        depth = len(folder.relative_to(source).parts)
        indent = "  " * depth
        lines.append(f"{indent}{folder.name}/  ({_subject(folder)})")
        modules = " ".join(
            sorted(p.stem for p in folder.glob("*.py") if p.stem not in ("__init__", "_version"))
            or sorted(p.name for p in folder.glob("*.[ch]"))
        )
        lines += textwrap.wrap(
            modules,
            WIDTH,
            initial_indent=indent + "    ",
            subsequent_indent=indent + "    ",
            break_on_hyphens=False,
        )
    return "\n".join(lines) + "\n"


def _subject(folder: Path) -> str:
    """Return the first line about a package, or about a library whose parts are in a folder."""
    if (folder / "__init__.py").exists():
        subject = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
    elif folder.with_suffix(".c").exists():
        subject = folder.with_suffix(".c").read_text("utf-8").removeprefix("/* ").partition(" */")[0]
    else:
        subject = "hand-written C: a file for each library, with its parts in a folder"
    subject = re.sub(r"^Layer \d: ", "", subject.partition("\n")[0]).rstrip(".")
    return subject[0].lower() + subject[1:] if subject[1:2].islower() else subject


if __name__ == "__main__":
    if sys.argv[1:] == ["--write"]:
        text = PAGE.read_text("utf-8")
        PAGE.write_text(BLOCK.sub(lambda _: tree(), text, count=1), "utf-8")
    else:
        print(tree(), end="")
