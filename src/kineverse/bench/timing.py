"""Races: everybody takes turns on the same work, in one run.

Times drift by a factor of two on machines that others use as well, so what counts is how contenders do beside
each other, round by round.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from kineverse.collection import no_collection

from .agreement import Array, check_agreement
from .result import Measurement
from .settings import Progress


@dataclass(frozen=True, slots=True)
class Contender:
    """Someone who does the work.

    Attributes
    ----------
    name
        Who, and how.
    sample
        Does the work and returns what it took, in ``unit``.
    results
        Returns the arrays that the work gives, which must be equal to those of the others; None if there is
        nothing to compare.
    unit
        ``s`` for times, or what is counted.
    """

    name: str
    sample: Callable[[], float]
    results: Callable[[], Sequence[Array]] | None = None
    unit: str = "s"


def timed(
    run: Callable[..., object], count: int = 1, prepare: Callable[[], Any] | None = None
) -> Callable[[], float]:
    """Return a sample: the time [s] that each of ``count`` pieces of work takes in ``run``.

    Parameters
    ----------
    run
        Does all of them.
    count
        How many that are.
    prepare
        Called before, outside of the time; ``run`` is given what it returns.
    """

    def sample() -> float:
        arguments = () if prepare is None else (prepare(),)
        start = perf_counter()
        run(*arguments)
        return (perf_counter() - start) / count

    return sample


def race(
    what: str, contenders: Sequence[Contender], rounds: int, progress: Progress
) -> dict[str, Measurement]:
    """Check that contenders compute the same, then measure them in turns; return measurements by name.

    Parameters
    ----------
    what
        The benchmark.
    contenders
        Who takes part.
    rounds
        How many times everybody takes a turn; another one before does not count.
    progress
        See :class:`.settings.Settings`.

    Raises
    ------
    DisagreementError
        If they do not compute the same.
    """
    results = [(c.name, c.results()) for c in contenders if c.results is not None]
    if results:
        check_agreement(what, results)
    samples: dict[str, list[float]] = {c.name: [] for c in contenders}
    for contender in contenders:
        contender.sample()
    for number in progress(range(rounds), what, "round"):
        # Nobody always comes after the same neighbour, who may leave caches warm or the processor hot.
        first = number % len(contenders)
        for contender in (*contenders[first:], *contenders[:first]):
            # The collector would charge everybody's garbage to whoever happens to run.
            with no_collection():
                samples[contender.name].append(contender.sample())
    return {c.name: Measurement(c.name, c.unit, tuple(samples[c.name])) for c in contenders}
