"""What a closed loop determines, as ranges: enclosed wherever its inputs are."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

from kineverse.bounds.enclosure import Enclosures
from kineverse.bounds.series import Series
from kineverse.bounds.terms import Term, Terms, reachable
from kineverse.expressions.implicit import ImplicitFunction


def solved(term: Term, inputs: list[Series]) -> Series:
    """Return the series of a step that is an unknown of an implicit function, from those of its inputs."""
    node, element = term.data
    return _solved(node.function, tuple(inputs))[element]


def loops_in(terms: Iterable[Term]) -> set[ImplicitFunction]:
    """Return the implicit functions among terms, and those in their equations."""
    found = {term.data[0].function for term in terms if term.op == "implicit"}
    return found.union(*map(_loops_below, found))


@lru_cache(256)
def _loops_below(function: ImplicitFunction) -> set[ImplicitFunction]:
    return loops_in(reachable(tuple(Terms({}).elements(function.chosen))))


# Bisection comes back to the same intervals for every unknown and every case.
@lru_cache(10_000)
def _solved(function: ImplicitFunction, inputs: tuple[Series, ...]) -> tuple[Series, ...]:
    return tuple(_enclosures(function).solved(function, list(inputs)))


@lru_cache(64)
def _enclosures(function: ImplicitFunction) -> Enclosures:
    return Enclosures(Terms({}))
