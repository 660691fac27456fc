"""Path of a planner: a polyline of configurations, or the reason why there is none."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse._names import answer_foreign_names
from kineverse._rich_display import draw_curves, element, html_table, picture_element
from kineverse._synonyms import PATH_SYNONYMS
from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .path_rounding import PathSection, TimedSection, parameterize_sections, section_times
from .state_validity import PathChecks, lengths_along
from .trajectories import MotionLimits, Trajectory, motion_limits
from .trajectories.kinematic_limits import RAMP

DEVIATION = 0.1  # largest distance of a trajectory from the corners of a path in free space [rad], [m]


@answer_foreign_names("A path", PATH_SYNONYMS)
@dataclass(frozen=True, eq=False)
class Path:
    """Result of :meth:`.Planner.plan`.

    Attributes
    ----------
    found
        True if the path leads to a goal and the collision scene has found no contact on it.
    symbols
        The n coordinates, the columns of :attr:`points`.
    points
        Configurations (N, n) that are joined by straight lines [m], [rad]. If no path was found, the best
        partial one: from the start to the point of the search that is nearest to a goal.
    why
        How the path was found, or why there is none.
    seconds
        Time of planning, the judgement by the scene included [s].
    search_seconds
        Time of search and shortcuts alone [s].
    iterations
        Number of samples of the search.
    state
        State in which everything else stands.
    checks
        Checks of configurations; None for a path that was pickled.
    modes
        Of a path through modes, the name of each with the indices of its first and last point.
    sections
        Parts with checks of their own, at whose ends the trajectory rests; empty for a path that is one part.

    See Also
    --------
    kineverse.planning.Planner
    """

    found: bool
    symbols: tuple[Symbol, ...]
    points: Array
    why: str
    seconds: float
    search_seconds: float
    iterations: int
    state: State
    checks: PathChecks | None = field(repr=False)
    modes: tuple[tuple[str, int, int], ...] = ()
    sections: tuple[PathSection, ...] = field(default=(), repr=False)

    @property
    def length(self) -> float:
        """Length of the polyline in the space of coordinates [m], [rad]."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    def clearance(self) -> float:
        """Return the least signed distance of bodies along the path by the scene [m].

        It is sampled 32 times a unit. Infinite if no pair is within .5 m.

        Raises
        ------
        InvalidValueError
            If the model has been edited since the path was planned, or the path was pickled.
        """
        return self._own_checks().clearance(self.points)

    def trajectory(
        self,
        *,
        deviation: npt.ArrayLike = DEVIATION,
        ramp: float = RAMP,
        velocity: npt.ArrayLike | None = None,
        acceleration: npt.ArrayLike | None = None,
    ) -> Trajectory:
        """Return the fastest motion along the path, from rest to rest.

        Corners are rounded as far as the motion is certainly free, and it stops at the others. Holds are
        met up to 1e-5 m or rad.

        Parameters
        ----------
        deviation
            Largest distance from the corners, in the norm of the coordinates [rad], [m]: a number, or one for
            each point (N,); 0 to stop at all of them.
        ramp
            Time from rest to full speed [s] where the model states no acceleration, see
            :func:`.motion_limits`.
        velocity, acceleration
            Largest speeds and accelerations (n,), which replace those of the model; a number for all
            coordinates applies in addition.

        Raises
        ------
        InvalidValueError
            If the path was not found, or the model has been edited since; as :func:`.time_parameterize`.
        """
        parts = self._parameterize(deviation, ramp, velocity, acceleration)
        return reduce(Trajectory.then, [trajectory for _, _, trajectory in parts])

    @cached_property
    def times(self) -> Array:
        """Times (N,) at which :meth:`trajectory` passes the points, or is nearest to them [s].

        Raises
        ------
        InvalidValueError
            As :meth:`trajectory`.
        """
        result = section_times(self.points, self._parameterize(DEVIATION, RAMP, None, None))
        result.flags.writeable = False
        return result

    def _parameterize(
        self,
        deviation: npt.ArrayLike,
        ramp: float,
        velocity: npt.ArrayLike | None,
        acceleration: npt.ArrayLike | None,
    ) -> list[TimedSection]:
        if not self.found:
            raise InvalidValueError(f"There is no path to move along. {self.why}")
        checks = self._own_checks()
        checks.ensure_current()
        limits = list(motion_limits(checks.model, self.symbols, ramp=ramp, state=self.state))
        for k, (name, other) in enumerate((("velocity=", velocity), ("acceleration=", acceleration))):
            if other is not None:
                # An array replaces the limits of the model (n,), and a number bounds them.
                chosen = _as_numbers(name, other)
                limits[k] = chosen if chosen.ndim or not chosen > 0 else np.minimum(limits[k], chosen)
        deviation = _as_numbers("deviation=", deviation)
        sections = self.sections or (PathSection(0, len(self.points) - 1, checks),)
        return parameterize_sections(self.points, self.symbols, MotionLimits(*limits), deviation, sections)

    def _own_checks(self) -> PathChecks:
        if self.checks is None:
            raise InvalidValueError(
                "This path was pickled without its collision checks: call path.trajectory() and "
                "path.clearance() in the process that planned it. Trajectories can be pickled."
            )
        return self.checks

    def __getstate__(self) -> dict[str, Any]:
        # Checks belong to one process.
        return {**self.__dict__, "checks": None, "sections": ()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the :meth:`trajectory` to a JSON file, see :meth:`.Trajectory.save`.

        Raises
        ------
        InvalidValueError
            As :meth:`trajectory`.
        """
        self.trajectory().save(path)

    def at(self, fraction: float) -> State:
        """Return the state at a fraction of the length, from 0 at the start to 1 at the end."""
        lengths = lengths_along(self.points)
        share = finite_number(fraction)
        if share is None:
            raise InvalidValueError(f"A fraction of a path is a number from 0 to 1, not {fraction!r}.")
        along = min(max(share, 0.0), 1.0) * lengths[-1]
        return self._state(np.array([np.interp(along, lengths, column) for column in self.points.T]))

    def states(self) -> Iterator[State]:
        """Yield the states at all points."""
        return map(self._state, self.points)

    def _state(self, q: Array) -> State:
        return self.state.updated(dict(zip(self.symbols, q.tolist(), strict=True)))

    def __bool__(self) -> bool:
        return self.found

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        if self.found:
            return f"<Path: {len(self.points)} points, length {self.length:.3g}, {1e3 * self.seconds:.3g} ms>"
        return f"<Path: not found. {self.why}>"

    def _repr_html_(self) -> str:
        names = [str(symbol) for symbol in self.symbols]
        if not self.found:
            return element("p", repr(self))
        lengths = lengths_along(self.points)
        curves = draw_curves(lengths, self.points, names, xlabel="length [rad], [m]")
        rows = [
            (name, *map(format_number, (*column[[0, -1]], column.min(), column.max())))
            for name, column in zip(names, self.points.T, strict=True)
        ]
        caption = (
            f"path of {len(self)} points, length {self.length:.3g}, found in {1e3 * self.seconds:.3g} ms"
        )
        table = html_table(caption, ("coordinate", "begin", "end", "least", "largest"), rows)
        return element("div", *([] if curves is None else [picture_element(curves, caption)]), table)


def _as_numbers(name: str, value: Any) -> Array:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise InvalidValueError(f"{name} is a number or an array of numbers, not {value!r:.80}.") from None
