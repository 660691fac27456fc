"""Run in a fresh process: the time that an import takes.

``import_time.py MODULE``
"""

import importlib
import json
import sys
from time import perf_counter


def main(module: str) -> None:
    """Import, and print how long it took [s]."""
    start = perf_counter()
    importlib.import_module(module)
    print(json.dumps({"seconds": perf_counter() - start}))


if __name__ == "__main__":
    main(*sys.argv[1:])
