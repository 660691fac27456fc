"""Write the tables of figures on the pages anew, by the commands that stand below them.

python tools/figures                     list them
python tools/figures --write NAME ...    run the commands of some, and write them; without names, of all
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from figures.documented import DOCUMENTED
from figures.writing import write_tables


def main() -> int:
    """List or write."""
    parser = argparse.ArgumentParser(
        prog="python tools/figures", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="run the commands, and write the tables")
    parser.add_argument("names", nargs="*", metavar="NAME", help="tables (all)")
    arguments = parser.parse_args()
    known = {one.name: one for one in DOCUMENTED}
    if unknown := [name for name in arguments.names if name not in known]:
        parser.error(f"there is no table {unknown[0]!r}; there are {', '.join(known)}")
    chosen = [known[name] for name in arguments.names or known]
    if not arguments.write:
        for one in chosen:
            sys.stdout.write(f"{one.name:20} {one.page:18} {one.command}\n")
        return 0
    write_tables(chosen)
    return 0


if __name__ == "__main__":
    sys.exit(main())
