"""Relay in a process of its own, which is there until it is killed."""

from __future__ import annotations

import sys

from kineverse.exchange.relay import Relay

from .processes import commands, tell


def main() -> None:
    server, listen, keys = sys.argv[1:]
    with Relay(server, listen=[listen], keys=keys) as relay:
        next(is_there for is_there in relay.watch() if is_there)
        tell(reply="connected")
        for _ in commands():
            pass


if __name__ == "__main__":
    main()
