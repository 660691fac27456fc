"""What formats can say."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """What a format can say.

    Attributes
    ----------
    name
        Of the format.
    sums
        Whether it limits sums of several coordinates.
    one_way
        Whether a speed may have another limit forwards than backwards.
    loops
        Whether it ties frames, so that what closes a loop needs not be solved for.
    degree
        Of the polynomials by which a joint may follow another.
    """

    name: str
    sums: bool = False
    one_way: bool = False
    loops: bool = False
    degree: int = 1
