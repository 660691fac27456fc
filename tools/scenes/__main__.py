"""Write the scenes of the gallery as documents.

python tools/scenes             write all
python tools/scenes NAME ...    write some
python tools/scenes --check     write nothing, fail where a file would change
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scenes import SCENES, scene_document, summaries

FOLDER = Path(__file__).resolve().parents[2] / "src" / "kineverse" / "gallery" / "scenes"


def main() -> int:
    """Write or compare scenes; return how many differ if they are compared."""
    parser = argparse.ArgumentParser(
        prog="python tools/scenes", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing, fail where a file would change")
    parser.add_argument("names", nargs="*", metavar="NAME", help="scenes (all)")
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.names if name not in SCENES]:
        parser.error(f"there is no scene {unknown[0]!r}; there are {', '.join(SCENES)}")
    different = 0
    for path, text in _files(arguments.names or list(SCENES)):
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        different += 1
        if arguments.check:
            sys.stderr.write(f"{path.name} is not what tools/scenes writes\n")
        else:
            path.write_text(text, encoding="utf-8")
            sys.stdout.write(f"{path.name} written\n")
    return different if arguments.check else 0


def _files(names: list[str]) -> Iterator[tuple[Path, str]]:
    yield FOLDER / "summaries.json", summaries()
    for name in names:
        yield FOLDER / f"{name}.kv.json", scene_document(name)


if __name__ == "__main__":
    sys.exit(main())
