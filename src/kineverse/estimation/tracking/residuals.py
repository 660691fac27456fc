"""Errors of what was seen against what the model says, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kineverse.compile import CompiledFunction
from kineverse.errors import ValueRejectedError
from kineverse.estimation.noise import Array
from kineverse.estimation.rotations import inverse_right_jacobian, logarithm

from .layout import Layout
from .observed import nearest
from .reading import Reading


class Residuals:
    """Whitened errors of observations: of a pose (p_seen - p, log(R_seen Rᵀ)), in the axes of the observer.

    Parameters
    ----------
    layout, function
        Where numbers are, and what computes them.
    """

    def __init__(self, layout: Layout, function: CompiledFunction) -> None:
        self._layout = layout
        self._function = function
        self._widths = [len(layout.groups[number].tangent) for number in layout.group_of]

    def evaluate(self, x: Array, known: Array) -> Array:
        """Return values and derivatives of everything at a state, not whitened."""
        found: Array = self._function(np.concatenate([x, known]))
        return found

    def errors(self, out: Array, reading: Reading, which: Sequence[int]) -> dict[int, tuple[Array, Array]]:
        """Return for each observation seen its whitened error (d,), and derivative of the model (d, t).

        Parameters
        ----------
        out
            What :meth:`evaluate` gave.
        which
            The observations that are wanted.
        """
        layout = self._layout
        seen = [i for i in which if reading.seen[i]]
        values = {i: reading.values[layout.seen_slices[i]] for i in seen}
        errors: dict[int, Array] = {}
        slopes: dict[int, Array] = {}
        for i in seen:
            size = layout.observations[i].size
            slopes[i] = out[layout.slope_slices[i]].reshape(size, self._widths[i])
        poses = [i for i in seen if layout.observations[i].is_pose]
        if poses:
            said = np.stack([out[layout.value_slices[i]] for i in poses])
            found = np.stack([values[i] for i in poses]).reshape(-1, 4, 4)
            turned = found[:, :3, :3] @ np.swapaxes(said[:, :9].reshape(-1, 3, 3), 1, 2)
            vectors = logarithm(turned)
            back = inverse_right_jacobian(vectors)
            errors.update(
                zip(poses, np.concatenate([found[:, :3, 3] - said[:, 9:], vectors], axis=1), strict=True)
            )
            for i, turn in zip(poses, back, strict=True):
                slope = slopes[i]
                slopes[i] = np.concatenate([slope[:3], turn @ slope[3:]])
        for i in seen:
            if i not in errors:
                errors[i] = nearest(values[i] - out[layout.value_slices[i]], layout.observations[i].period)
        pairs = {}
        for i in seen:
            size = layout.observations[i].size
            white = reading.whitening[layout.white_slices[i]].reshape(size, size)
            pairs[i] = white @ errors[i], white @ slopes[i]
        return pairs

    def check(self, out: Array, which: Sequence[int]) -> None:
        """Raise an error that names an observation whose value or derivative is not finite.

        Raises
        ------
        ValueRejectedError
            Naming it.
        """
        for i in which:
            one = self._layout.observations[i]
            for where in (self._layout.value_slices[i], self._layout.slope_slices[i]):
                if not np.isfinite(out[where]).all():
                    raise ValueRejectedError(
                        f"The model says nothing finite about '{one.label}' or its derivative at the present "
                        "estimate. Give start= a state where it does, or the model limits."
                    )
