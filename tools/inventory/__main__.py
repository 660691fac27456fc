"""Write down what a user meets, and compare two such inventories: nothing is lost by a refactoring.

python tools/inventory --write FILE [--only SECTION ...] [--data FOLDER]
python tools/inventory --compare BEFORE AFTER [--all]

Sections are independent, and added to FILE one by one. The comparison ends with status 1 if anything differs
but places, times, the wording of help, and sizes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from inventory.bounded import ROOT, import_path, run
from inventory.compare import compare
from inventory.sections import SECTIONS, entries

MINUTES = 180


def write(file: Path, sections: list[str], data: Path | None) -> None:
    """Add sections to a file; each is made by a process of its own."""
    for name in sections:
        begin = time.monotonic()
        words = [sys.executable, __file__, "--section", name, *(["--data", str(data)] if data else [])]
        ended = run(words, 60 * MINUTES, ROOT)
        made = json.loads(file.read_text("utf-8")) if file.is_file() else {}
        if ended.status == 0:
            made[name] = json.loads(ended.out)
            said = f"{len(made[name])} entries"
        else:
            said = f"failed: {(ended.err.strip().splitlines() or ['too long'])[-1]}"
            made[name] = {"": said}
        sys.stdout.write(f"{name:10} {said}, {time.monotonic() - begin:.0f} s\n")
        sys.stdout.flush()
        ordered = {name: made[name] for name in SECTIONS if name in made}
        file.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", "utf-8")


def main() -> int:
    """Write or compare."""
    parser = argparse.ArgumentParser(
        prog="python tools/inventory",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--write", type=Path, metavar="FILE", help="make the sections, and add them to a file")
    task.add_argument("--compare", nargs=2, type=Path, metavar=("BEFORE", "AFTER"), help="print differences")
    task.add_argument("--section", choices=SECTIONS, help=argparse.SUPPRESS)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="some sections")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="robots and furniture (tests/DATA.md)")
    parser.add_argument("--all", action="store_true", help="print all differences, not the first ones")
    arguments = parser.parse_args()
    data = arguments.data.resolve() if arguments.data else None
    if data and not data.is_dir():
        parser.error(f"{data} is no folder")
    if arguments.compare:
        before, after = (json.loads(file.read_text("utf-8")) for file in arguments.compare)
        return compare(before, after, None if arguments.all else 15)
    if arguments.section:
        out, sys.stdout = sys.stdout, sys.stderr  # what is printed on the way does not belong to the section
        sys.path[:0] = import_path()
        found = entries(arguments.section, data)
        json.dump(found, out, sort_keys=True)
        return 0
    write(arguments.write, arguments.only, data)
    return 0


if __name__ == "__main__":
    sys.exit(main())
