"""The papers' extended Kalman filter over entries of poses (2020 paper, IV-A; 2022, IV-B).

It is implemented as published, for reproduction and comparison. By design it treats the entries of rotation
matrices as independent numbers, knows their noise at one configuration only, and uses limits only for the
start.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, ModelError, ShapeError, UnknownNameError, suggest
from kineverse.expressions import Expression, array
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

STEPS = 10
STEP_SIZE = 0.1
SPREAD = 0.5


class PaperEkf:
    """Extended Kalman filter of coordinates q over entries of poses, as published.

    An observation is z = h(q): those entries of the frames' 4×4 matrices that depend on a coordinate. Frames
    that share coordinates form a group, and each group has a filter of its own:

    - start: the middle of the limits, ±π without, and Σ = diag((½ width)²);
    - first observation: ten steps q += 0.1 Hᵀ (z - h(q)), with H = ∂h/∂q; Σ stays;
    - prediction: q += Δt q̇, with Q = 0;
    - later observations: S = H Σ Hᵀ + R, K = Σ Hᵀ S⁻¹, q += K (z - h(q)), Σ = (I - K H) Σ.

    R is the covariance of entries in noisy poses at one configuration, see :meth:`learn_noise`.
    """

    def __init__(
        self,
        model: ModelView,
        frames: Iterable[str],
        steps: int = STEPS,
        spread: float = SPREAD,
        copies: int | None = None,
    ) -> None:
        self.frames = tuple(frames)
        self._steps, self._spread = steps, spread
        self._lead = () if copies is None else (copies,)
        self._groups = _groups(model, self.frames)
        self.groups = tuple(group.symbols for group in self._groups)
        self.symbols = tuple(s for symbols in self.groups for s in symbols)
        self.limits = _position_limits(model, self.symbols)
        self._entries = np.concatenate([group.entries for group in self._groups])
        outputs = [part for group in self._groups for part in (group.h, group.h.jacobian(group.symbols))]
        self.function = compile(outputs, self.symbols)
        self._bound = self.function.bind()
        self.reset()

    def reset(self) -> None:
        lower, upper = self.limits.T
        self.q = np.broadcast_to((lower + upper) / 2, (*self._lead, len(self.symbols))).copy()
        for group in self._groups:
            width = (upper - lower)[group.columns]
            covariance = np.diag((self._spread * width) ** 2)
            group.covariance = np.broadcast_to(covariance, (*self._lead, *covariance.shape))
        self._started = False

    def learn_noise(self, poses: npt.ArrayLike) -> None:
        """Estimate R as the covariance of noisy poses at one configuration."""
        seen = self._observed_entries(poses, np.shape(poses)[:1])
        if len(seen) < 2:
            raise InvalidValueError("One observation has no covariance; the papers take 400.")
        for group in self._groups:
            group.noise = np.cov(seen[:, group.rows], rowvar=False).reshape([len(group.entries)] * 2)

    def predict(self, dt: float, speeds: Mapping[Symbol | str, float] | None = None) -> None:
        """Predict the estimate by q += Δt q̇."""
        if not speeds:
            return
        by_name = {str(s.derivative()): i for i, s in enumerate(self.symbols)}
        for symbol, speed in speeds.items():
            if str(symbol) not in by_name:
                raise UnknownNameError(
                    f"'{symbol}' is no velocity here. {suggest(str(symbol), by_name, 'one')}"
                )
            self.q[..., by_name[str(symbol)]] += dt * speed

    def update(self, poses: npt.ArrayLike) -> Array:
        z = self._observed_entries(poses, self._lead)
        q, covariances = self._kalman_update(z) if self._started else self._gradient_steps(z)
        if not np.isfinite(q).all():
            raise InvalidValueError(
                f"The step from {', '.join(map(str, self.symbols))} = {self.q} leads nowhere: this filter is "
                "not kept within limits, and beyond them the model need not mean anything."
            )
        for group, covariance in zip(self._groups, covariances, strict=True):
            group.covariance = covariance
        self.q, self._started = q, True
        return q.copy()

    @property
    def covariance(self) -> Array:
        """Covariance Σ of all coordinates, block diagonal, (n, n) or (copies, n, n)."""
        n = len(self.symbols)
        found = np.zeros((*self._lead, n, n))
        for group in self._groups:
            found[..., group.columns[:, None], group.columns] = group.covariance
        return found

    def _gradient_steps(self, z: Array) -> tuple[Array, list[Array]]:
        q = self.q.copy()
        for _ in range(self._steps):
            for group, h, H in self._evaluate_groups(q):
                y = z[..., group.rows] - h
                q[..., group.columns] += STEP_SIZE * (np.swapaxes(H, -1, -2) @ y[..., None])[..., 0]
        return q, [group.covariance for group in self._groups]

    def _kalman_update(self, z: Array) -> tuple[Array, list[Array]]:
        q, covariances = self.q.copy(), []
        for group, h, H in self._evaluate_groups(q):
            gain = group.gain(H)
            y = z[..., group.rows] - h
            q[..., group.columns] += (gain @ y[..., None])[..., 0]
            covariances.append(group.covariance - gain @ H @ group.covariance)
        return q, covariances

    def _evaluate_groups(self, q: Array) -> list[tuple[_CoordinateGroup, Array, Array]]:
        if self._lead:
            values = self.function.batch(q)
        else:
            self._bound(q)
            values = self._bound.outputs
        return list(zip(self._groups, values[::2], values[1::2], strict=True))

    def _observed_entries(self, poses: npt.ArrayLike, lead: tuple[int, ...]) -> Array:
        seen = np.asarray(poses, dtype=np.float64)
        wanted = (*lead, len(self.frames), 4, 4)
        if seen.shape != wanted:
            raise ShapeError(f"The poses are of shape {seen.shape}, expected is {wanted}.")
        entries: Array = seen.reshape(*lead, -1)[..., self._entries]
        if not np.isfinite(entries).all():
            raise InvalidValueError("A pose contains NaN or infinity.")
        return entries


@dataclass(eq=False)
class _CoordinateGroup:
    """Coordinates that share observations; indices of columns, of entries of all poses, and of rows."""

    symbols: tuple[Symbol, ...]
    columns: npt.NDArray[np.intp]
    entries: npt.NDArray[np.intp]
    rows: slice
    h: Expression
    covariance: Array = field(default_factory=lambda: np.empty(0))
    noise: Array | None = None

    def gain(self, H: Array) -> Array:
        """Return K = Σ Hᵀ (H Σ Hᵀ + R)⁻¹."""
        names = ", ".join(map(str, self.symbols))
        if self.noise is None:
            raise InvalidValueError(f"The noise of what shows {names} is not known: call learn_noise first.")
        across = self.covariance @ np.swapaxes(H, -1, -2)
        try:
            # The explicit inverse, as published: its cost is part of the comparison.
            gain: Array = across @ np.linalg.inv(H @ across + self.noise)
        except np.linalg.LinAlgError:
            raise InvalidValueError(
                f"The covariance of what is expected for {names} is singular: R has directions without noise."
            ) from None
        return gain


def _groups(model: ModelView, frames: Sequence[str]) -> list[_CoordinateGroup]:
    if not frames:
        raise InvalidValueError("No frame is observed.")
    members: list[tuple[set[Symbol], list[tuple[int, Expression]]]] = []
    for i, frame in enumerate(frames):
        entries = _moving_entries(model, frame)
        symbols = {s for _, e in entries for s in e.symbols}
        listed = [(16 * i + place, e) for place, e in entries]
        shared = [group for group in members if group[0] & symbols]
        members = [group for group in members if group not in shared]
        members.append(
            (symbols.union(*(s for s, _ in shared)), [e for _, other in shared for e in other] + listed)
        )
    members.sort(key=lambda group: group[1][0][0])
    groups, columns, rows = [], 0, 0
    for symbols, listed in members:
        ordered = tuple(sorted(symbols, key=lambda s: s.sort_key))
        groups.append(
            _CoordinateGroup(
                ordered,
                np.arange(columns, columns + len(ordered)),
                np.array([place for place, _ in listed]),
                slice(rows, rows + len(listed)),
                array([e for _, e in listed]),
            )
        )
        columns, rows = columns + len(ordered), rows + len(listed)
    return groups


def _moving_entries(model: ModelView, frame: str) -> list[tuple[int, Expression]]:
    """Return the entries of a pose that depend on a coordinate, with their indices row by row."""
    pose = model.fk(frame)
    parameters = {s: s.value for s in pose.symbols if s.value is not None}
    if parameters:
        pose = pose.substitute(parameters)
    found = [(4 * i + j, e) for i in range(3) for j in range(4) if (e := pose[i, j]).symbols]
    if not found:
        raise ModelError(f"Frame '{frame}' depends on no coordinate: observing it says nothing about any.")
    return found


def _position_limits(model: ModelView, symbols: Sequence[Symbol]) -> Array:
    found = np.array([model.limits(s) for s in symbols])
    return np.where(np.isfinite(found), found, [-math.pi, math.pi])
