"""Whether those who are compared do the same work."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError

Array: TypeAlias = npt.NDArray[np.float64]

TOLERANCE = 1e-9
"""How far poses and Jacobians may be apart [m], [rad]."""


class DisagreementError(KineverseError, ArithmeticError):
    """Those who are compared do not compute the same, so their times mean nothing."""


def check_agreement(
    what: str, results: Sequence[tuple[str, Sequence[Array]]], tolerance: float = TOLERANCE
) -> None:
    """Compare the arrays that contenders computed with those of the first one.

    Parameters
    ----------
    what
        The benchmark, for the message.
    results
        Names, each with arrays.
    tolerance
        How far their numbers may be apart.

    Raises
    ------
    DisagreementError
        If an array has another shape, or numbers that are further off or not finite.
    """
    (first, wanted), *others = results
    if not all(np.isfinite(array).all() for array in wanted):
        raise DisagreementError(f"Benchmark {what!r}: {first!r} computed what is not finite.")
    for name, found in others:
        shapes = [np.shape(array) for array in wanted], [np.shape(array) for array in found]
        if shapes[0] != shapes[1]:
            raise DisagreementError(
                f"Benchmark {what!r}: {name!r} gave arrays of shapes {shapes[1]}, {first!r} {shapes[0]}."
            )
        for k, (ours, theirs) in enumerate(zip(wanted, found, strict=True)):
            error = float(np.max(np.abs(np.asarray(theirs) - ours), initial=0.0))
            # Written so that NaN is refused as well.
            if not error <= tolerance:
                raise DisagreementError(
                    f"Benchmark {what!r}: {name!r} and {first!r} differ by {error:.3g} in result {k}, "
                    f"more than {tolerance:g}. Their times cannot be compared."
                )
