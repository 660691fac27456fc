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
PAGE = ROOT / "docs" / "architecture.md"
BLOCK = re.compile(r"(?<=## Source tree\n\n```text\n).*?(?=```\n)", re.DOTALL)
WIDTH = 118


def tree() -> str:
    """Return one paragraph for each package: its name, its subject and its modules."""
    return _draw(ROOT / "src" / "kineverse") + _draw(ROOT / "studies" / "kineverse_studies")


def _draw(source: Path) -> str:
    lines: list[str] = []
    folders = [source, *sorted(p.parent for p in source.rglob("__init__.py") if p.parent != source)]
    for folder in folders:
        depth = len(folder.relative_to(source).parts)
        indent = "  " * depth
        subject = (ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or "").partition(
            "\n"
        )[0]
        subject = re.sub(r"^Layer \d: ", "", subject).rstrip(".")
        if subject[1:2].islower():
            subject = subject[0].lower() + subject[1:]
        lines.append(f"{indent}{folder.name}/  ({subject})")
        modules = " ".join(
            sorted(p.stem for p in folder.glob("*.py") if p.stem not in ("__init__", "_version"))
        )
        lines += textwrap.wrap(
            modules,
            WIDTH,
            initial_indent=indent + "    ",
            subsequent_indent=indent + "    ",
            break_on_hyphens=False,
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if sys.argv[1:] == ["--write"]:
        text = PAGE.read_text("utf-8")
        PAGE.write_text(BLOCK.sub(lambda _: tree(), text, count=1), "utf-8")
    else:
        print(tree(), end="")
