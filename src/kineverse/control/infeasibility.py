from typing import NamedTuple


class Conflict(NamedTuple):
    name: str
    operations: tuple
    lower: float
    upper: float


def find_irreducible_conflict(A, lower, upper):
    return []


def find_least_violation(A, lower, upper, hard):
    raise NotImplementedError
