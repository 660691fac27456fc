"""Fresh processes, for what happens once in each."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from kineverse.errors import KineverseError

PROGRAMS = Path(__file__).parent / "programs"


class ProgramError(KineverseError, RuntimeError):
    """What was to be measured in a process of its own did not get to its end."""


def run_program(name: str, *arguments: str, cache: str | None = None) -> dict[str, Any]:
    """Run one of the programs in a fresh process; return what it says.

    Parameters
    ----------
    name
        The program's file, without suffix.
    arguments
        What it is given.
    cache
        Where compiled code is kept; where it always is if None.

    Raises
    ------
    ProgramError
        If it fails, with what it said last.
    """
    environment = dict(os.environ)
    if cache is not None:
        environment["KINEVERSE_CACHE_DIR"] = cache
    # With -P the program's neighbours cannot be imported by accident.
    command = [sys.executable, "-P", str(PROGRAMS / f"{name}.py"), *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    try:
        said: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        last = (done.stderr.strip() or "it said nothing").splitlines()[-1]
        raise ProgramError(f"The program {name!r} ended with status {done.returncode}: {last}") from None
    return said
