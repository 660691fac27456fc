"""Write the models that ship: `python tools/models` writes them, `--check` only compares."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fetch import fetch
from hsr import hsr
from kitchen import kitchen
from pr2 import pr2
from shelves import shelf_door, shelf_drawers

SHIPPED = Path(__file__).resolve().parents[2] / "src" / "kineverse" / "shipped"


def main() -> int:
    """Write or compare every model; return how many differ."""
    parser = argparse.ArgumentParser(prog="python tools/models", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing, fail where a file would change")
    check = parser.parse_args().check
    different = 0
    for description in (kitchen(), shelf_door(), shelf_drawers(), pr2(), fetch(), hsr()):
        path = SHIPPED / f"{description.name}.urdf"
        text = description.xml()
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        different += 1
        if check:
            sys.stderr.write(f"{path.name} is not what tools/models writes\n")
        else:
            path.write_text(text, encoding="utf-8")
            sys.stdout.write(f"{path.name} written\n")
    return different if check else 0


if __name__ == "__main__":
    sys.exit(main())
