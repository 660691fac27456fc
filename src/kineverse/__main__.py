"""Command line as ``python -m kineverse``, if the command is not on the path."""

from __future__ import annotations

import sys

from kineverse.cli.command_line import main

if __name__ == "__main__":
    sys.exit(main())
