"""Build the distributions, check them, and try them as a user would: ``make release``.

make release                           into dist; all trials take some minutes, and install 2 GB
make release ARGS="--only core view"   some of the trials; --only none: only build and check

Nothing is published. docs/release.md says what is checked and tried.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import trials
from build_distributions import build, check

ROOT = Path(__file__).parents[2]


def main() -> int:
    """Build, check and try what the arguments name, and return 1 at the first thing that is wrong."""
    parser = argparse.ArgumentParser(prog="make release", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=[*trials.TRIALS, "none"], help="trials to make (all)")
    parser.add_argument("--into", type=Path, default=ROOT / "dist", help="folder of the archives (dist)")
    arguments = parser.parse_args()
    shutil.rmtree(arguments.into, ignore_errors=True)
    try:
        with tempfile.TemporaryDirectory(prefix="kineverse-release-") as folder:
            clean = Path(folder, "checkout")
            archives = build(ROOT, arguments.into, Path(folder), clean)
            check(ROOT, archives, clean)
            for name in arguments.only or trials.TRIALS:
                if name != "none":
                    trials.try_out(name, archives, Path(folder, name))
    except (subprocess.CalledProcessError, AssertionError) as error:
        print(
            error.stdout if isinstance(error, subprocess.CalledProcessError) and error.stdout else "", end=""
        )
        print(f"The release is not ready: {error}", file=sys.stderr)
        return 1
    print("\n".join(["Ready:", *(f"  {archive}" for archive in sorted(arguments.into.iterdir()))]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
