"""Model server in a process of its own, whose disk and clock can be spoilt."""

from __future__ import annotations

import random
import sys
import threading
import time
from pathlib import Path

from faults.processes import commands, tell

NAME = "home"


def jump(seed: int) -> None:
    """Let the clock jump back and forth by up to a year, each time that it is read."""
    clock, chance = time.time, random.Random(seed)
    time.time = lambda: clock() + chance.choice((0, -3.2e7, 3.2e7, chance.uniform(-100, 100)))


def answer_late() -> None:
    """Wait between what is stored and its answer, so that many are killed there."""
    from kineverse.exchange.transport import Question

    answer = Question.answer

    def wait_and_answer(self: Question, payload: bytes) -> None:
        time.sleep(random.uniform(0, 0.01))
        answer(self, payload)

    Question.answer = wait_and_answer  # type: ignore[method-assign]


def set_limit(size: int) -> None:
    """Let all files have at most a size [byte]; 0: any size."""
    import resource

    most = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (size or most, most))


def main() -> None:
    path, how = Path(sys.argv[1]), sys.argv[2:]
    keys, listen = (
        [word.removeprefix(f"{option}=") for word in how if word.startswith(f"{option}=")]
        for option in ("keys", "listen")
    )
    if "jump" in how:
        jump(1)
    if "late" in how:
        answer_late()
    from kineverse.exchange.server import serve
    from kineverse.formats import document_hash

    with serve(store=path, name=NAME, listen=listen, keys=keys[0] if keys else None) as server:
        threading.Thread(target=server.run, daemon=True).start()  # as the command does
        tell(reply="ready")
        for words in commands():
            if words[0] == "state":
                snapshot = server.snapshot()
                tell(reply=[snapshot.version, document_hash(snapshot)])
            elif words[0] == "room":  # up to some part of the file that commits are written to
                size = Path(f"{path}-wal").stat().st_size
                set_limit(1 + round(float(words[1]) * size))
                tell(reply=size)
            elif words[0] == "any-room":
                set_limit(0)
                tell(reply="ready")


if __name__ == "__main__":
    main()
