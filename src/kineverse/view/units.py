"""Whether a degree of freedom turns or shifts.

A model says by mathematics alone what its coordinates do, so their units are read off the motion: a
coordinate that turns some frame by one radian a unit is an angle, one that shifts a frame by one metre a unit
is a length, and of the others (a door lifted by a rope, a screw) nothing is claimed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress

import numpy as np

import kineverse as kv
from kineverse.errors import UnsolvedError
from kineverse.model.view import ModelView
from kineverse.view.triangles import Floats

STEP = 1e-4
"""Step of the differences; their error is its square [unit of the coordinate]."""

TOLERANCE = 1e-5

DISTANCES = (0.0, 1.0, -1.0, 0.1, -0.1)
"""Where to look, from the given values on; the later ones are for where nothing is found in the others."""


def units(model: ModelView, values: Mapping[str, float], names: Iterable[str]) -> dict[str, str]:
    """Return ``"rad"``, ``"m"`` or ``""`` for each of the named symbols.

    Parameters
    ----------
    model
        The model; its transforms from parent to child are what is looked at.
    values
        Values of all symbols at which to look, by name [rad], [m].
    names
        The symbols wanted.
    """
    wanted = list(names)
    # In terms of what is free: the angles of a closed loop follow its crank.
    moving = [t for frame in model.frames.values() if (t := model.rates.carry(frame.transform)).symbols]
    if not moving:
        return dict.fromkeys(wanted, "")
    function = kv.compile(moving)
    inputs = [str(symbol) for symbol in function.inputs]
    base = np.array([values[name] for name in inputs])

    def rates(place: Floats, index: int) -> tuple[Floats, Floats]:
        offset = np.zeros(len(inputs))
        offset[index] = STEP
        return _rates(np.array(function(place - offset)), np.array(function(place + offset)))

    found = dict.fromkeys(wanted, "")
    # A second place, a little off: what is one radian a unit only by chance is not so there.
    off = 0.1 + 0.01 * np.arange(len(base))
    for name in wanted:
        if name not in inputs:
            continue
        seen = []
        for distance in DISTANCES:
            # Where a loop does not close there is nothing to look at; two places are enough.
            with suppress(UnsolvedError):
                seen.append(rates(base + distance * off, inputs.index(name)))
            if len(seen) == 2:
                break
        if len(seen) < 2:
            continue
        turning = np.all([np.abs(turn - 1.0) < TOLERANCE for turn, _ in seen], axis=0)
        shifting = np.all([(turn < TOLERANCE) & (np.abs(s - 1.0) < TOLERANCE) for turn, s in seen], axis=0)
        found[name] = "rad" if turning.any() else "m" if shifting.any() else ""
    return found


def _rates(before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """Return the (N,) rates of turning [rad] and shifting [m] a unit, from poses two steps apart."""
    with np.errstate(invalid="ignore"):  # A frame that is nowhere does not turn or shift by one a unit.
        return _differences(before, after)


def _differences(before: Floats, after: Floats) -> tuple[Floats, Floats]:
    # The part of R_before' R_after that is antisymmetric is the sine of the angle between them.
    change = np.einsum("nji,njk->nik", before[:, :3, :3], after[:, :3, :3])
    sine = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)
    turn = np.linalg.norm(
        sine - np.stack([change[:, 1, 2], change[:, 2, 0], change[:, 0, 1]], axis=1), axis=1
    )
    shift = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    return np.asarray(turn / 2.0 / (2.0 * STEP)), np.asarray(shift / (2.0 * STEP))
