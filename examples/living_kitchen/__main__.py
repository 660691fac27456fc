"""``python examples/living_kitchen``: the living kitchen, with the options of ``kineverse demo --living``."""

import sys
from pathlib import Path

# Python puts this folder on the path, where its modules could hide others of their names.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from kineverse.cli import main  # noqa: E402 - after the path

sys.exit(main(["demo", "--living", *sys.argv[1:]]))
