"""Odometry of mobile bases: residuals of poses that were seen along a drive, by the angles of the wheels.

Between two readings of the wheels the base moves with a constant twist, along an arc. The arcs of a drive
and their derivatives by the free parameters are cumulative sums of arrays. So each step of a calibration
integrates the drive anew, exactly, and nothing is compiled for a number of readings.

Where a drive began is not known: x, y and angle at its start are eliminated by least squares (variable
projection, Golub and Pereyra 1973). So each seen pose has the noise of one pose, and no noise is shared. If a
wheel slips, all poses after it are displaced: the drive is cut there, and begins anew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError, list_some, suggest
from kineverse.estimation.noise import CHI_SQUARED_6, Outliers, check_covariance, check_rigid
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Array, inverse, inverse_right_jacobian, log_so3, mean_rotation
from kineverse.model.articulation import Articulation
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .observations import NoiseGroup

if TYPE_CHECKING:
    from .observations import ResidualBlock

Indices: TypeAlias = npt.NDArray[np.intp]

_PERSISTENT = 3  # successive poses that fit each other and not those before: a slip, no gross error
_ROBUST_STEPS = 30  # largest number of steps of the first, robust fit
_SLIP = 30.7  # quantile of χ² with three degrees of freedom that is exceeded once in a million
_MEDIAN = 2.366  # median of χ² with three degrees of freedom
_FINEST = 1e-7  # smallest standard deviation of a pose; below it rounding is larger [m], [rad]
_SETTLED = 1e-12  # squared length of the last step to a start, in standard deviations
_STARTS = 10  # largest number of steps to the start of a drive, which converges in three
_SHORT_ARC = 0.01  # angle below which the series of sines are exact to the last bit [rad]


@dataclass(frozen=True, eq=False)
class WheelOdometry:
    """Drive of a mobile base: the angles of its wheels over time, and poses that were seen along it.

    Attributes
    ----------
    base
        Name of the mobile base, such as ``fetch/base``.
    times
        Times of the readings of the wheels (K,) [s], increasing.
    wheels
        Readings (K,) by the name of each wheel: its angle [rad], counted on beyond full turns. Of the speed
        of a base without wheels, such as ``car/drive``, the distance [m]; of a coordinate that the rates
        depend on, such as ``car/steering``, its value [rad].
    seen_at, poses
        Times (N,) [s] at which poses (N, 4, 4) were seen, within those of the readings, increasing.
    frame
        Frame whose poses were seen; that of the base by default.
    relative_to
        Frame that they were seen in, which the base does not move.
    covariance
        6×6, of each pose, as for :class:`.ObservedPose`; estimated from the data by default.
    state
        Values of other coordinates between base and frame, such as those of a neck, which stay the same.
    restart
        Longest time [s] after which the start is estimated anew, for wheels that slip all the time a little;
        None if they do not.

    Examples
    --------
    >>> times = np.linspace(0, 1, 21)
    >>> wheels = {"fetch/base/left_wheel": 2 * times, "fetch/base/right_wheel": 2 * times}
    >>> poses = [kv.translation(0.06 * 2 * t, 0, 0)() for t in times[::10]]
    >>> drive = kv.estimation.WheelOdometry("fetch/base", times, wheels, times[::10], poses)
    >>> drive.base  # a recording for calibrate(model, [drive], "wheels fetch/base")
    'fetch/base'
    """

    base: str
    times: npt.ArrayLike
    wheels: Mapping[Symbol | str, npt.ArrayLike]
    seen_at: npt.ArrayLike
    poses: npt.ArrayLike
    frame: str = ""
    relative_to: str = WORLD
    covariance: npt.ArrayLike | None = None
    state: StateLike = field(default_factory=dict)
    restart: float | None = None

    def residual_block(self, model: ModelView, free: Sequence[Symbol], look: int) -> ResidualBlock:
        """Return the residuals of the seen poses, see :class:`.BlockSource`.

        Raises
        ------
        InvalidValueError, ShapeError, UnknownNameError
            For a base that does not move by speeds, readings that are missing, of another length or not
            finite or without full turns, and poses outside of the times of the readings.
        """
        if self.restart is not None and not (finite_number(self.restart) or 0.0) > 0.0:
            raise InvalidValueError(
                f"The drive of '{self.base}': restart= is a time above 0 s, not {self.restart!r:.40}."
            )
        return OdometryBlock(self, model, _find_base(model, self.base), tuple(free), look)


def _find_base(model: ModelView, name: str) -> Articulation:
    record = model.articulations.get(name)
    planar = [n for n, r in model.articulations.items() if len(r.coordinates) >= 3 and _moves_by_speeds(r)]
    if record is None:
        raise UnknownNameError(f"There is no mobile base '{name}'. {suggest(name, planar, 'base')}")
    if len(record.coordinates) < 3 or not _moves_by_speeds(record):
        have = f"Bases are {list_some(planar, 4)}." if planar else "The model has none."
        raise InvalidValueError(f"'{name}' is no base on wheels, whose x, y and angle move by speeds. {have}")
    return record


def _moves_by_speeds(record: Articulation) -> bool:
    return bool(record.speeds) and not {c.derivative() for c in record.coordinates[:3]} & {*record.speeds}


# -- readings --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Readings:
    """Checked readings, with those at the times of the poses put between them."""

    increments: Array  # of each speed's integral in each step, (K, m)
    speeds: tuple[Symbol, ...]
    middles: dict[Symbol, Array]  # other coordinates in the middle of each step
    seen: npt.NDArray[np.int_]  # number of steps before each pose, (N,)
    seen_at: Array

    @classmethod
    def of(cls, given: WheelOdometry, record: Articulation) -> _Readings:
        """Check and merge the readings of a drive."""
        what = f"The drive of '{given.base}'"
        times = _series(f"{what}: its times", given.times)
        seen_at = _series(f"{what}: seen_at", given.seen_at)
        if len(times) < 2 or not len(seen_at):
            raise InvalidValueError(f"{what} has {len(times)} readings and {len(seen_at)} poses: too few.")
        for name, values in (("times", times), ("seen_at", seen_at)):
            late = np.flatnonzero(np.diff(values) <= 0.0)
            if len(late):
                k = int(late[0])
                raise InvalidValueError(
                    f"{what}: {name} increase, but {values[k + 1]:.6g} s follows {values[k]:.6g} s."
                )
        if seen_at[0] < times[0] or seen_at[-1] > times[-1]:
            raise InvalidValueError(
                f"{what}: poses were seen from {seen_at[0]:.6g} s to {seen_at[-1]:.6g} s, its wheels were "
                f"read from {times[0]:.6g} s to {times[-1]:.6g} s. Leave out the poses before and after."
            )
        series = {str(name): _series(f"{what}: '{name}'", v, len(times)) for name, v in given.wheels.items()}
        wrapped = next((name for name, values in series.items() if _is_wrapped(values)), None)
        if wrapped is not None:
            raise InvalidValueError(
                f"{what}: '{wrapped}' begins anew after each full turn. Count the turns on, as "
                "numpy.unwrap does."
            )
        merged = np.union1d(times, seen_at)
        steps = {name: np.interp(merged, times, values) for name, values in series.items()}
        paths = {speed: speed.position.path for speed in record.speeds}
        needed = [p for s, p in paths.items() if s not in {c.derivative() for c in record.coordinates}]
        others = [c.path for c in record.coordinates[3:]]
        missing = [path for path in (*needed, *others) if path not in steps]
        if missing:
            spare = [name for name in steps if name not in (*needed, *others)]
            hint = f" There is {list_some(map(repr, spare), 4)}." if spare else ""
            raise UnknownNameError(
                f"{what} needs the readings of {list_some(map(repr, (*needed, *others)), 6)}; those of "
                f"'{missing[0]}' are missing.{hint}"
            )
        increments = np.stack([np.diff(steps[paths[s]]) for s in record.speeds], axis=1)
        middles = {c: (steps[c.path][1:] + steps[c.path][:-1]) / 2 for c in record.coordinates[3:]}
        return cls(increments, record.speeds, middles, np.searchsorted(merged, seen_at), seen_at)


def _is_wrapped(values: Array) -> bool:
    """Return True for angles within one turn that jump back by more than a half against their motion."""
    steps = np.diff(values)
    back = (np.abs(steps[1:]) > math.pi) & (steps[1:] * steps[:-1] < 0.0)
    return bool(back.any()) and float(np.ptp(values)) <= math.tau


def _series(what: str, given: npt.ArrayLike, length: int | None = None) -> Array:
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise ShapeError(f"{what} are numbers, one for each time, not {given!r:.60}.") from None
    if values.ndim != 1 or (length is not None and len(values) != length):
        wanted = "one number for each time" if length is None else f"{length} numbers, one for each time"
        raise ShapeError(f"{what}: {wanted} are expected, not an array of shape {values.shape}.")
    wrong = np.flatnonzero(~np.isfinite(values))
    if len(wrong):
        raise InvalidValueError(f"{what}: number {wrong[0]} is {values[wrong[0]]}.")
    return values


# -- arcs ------------------------------------------------------------------------------------------------


class DrivenPath(NamedTuple):
    """Planar poses x, y [m] and angle [rad] along a drive that begins at 0, and their derivatives."""

    poses: Array  # (K + 1, 3)
    slopes: Array  # (K + 1, 3, p)


def integrate_arcs(twists: Array, slopes: Array) -> DrivenPath:
    """Integrate twists times duration, (K, 3): forward, left and about z, in the axes of the base.

    A step is the exponential of SE(2): R(θ) V(c) (a, b) with V(c) = ∫₀¹ R(tc) dt, and θ + c (Lynch and Park,
    Modern Robotics, 13.4). ``slopes``, (K, 3, p), are the derivatives of the twists.
    """
    a, b, c = twists.T
    small = np.abs(c) < _SHORT_ARC
    safe = np.where(small, 1.0, c)
    s = c * c
    sine = np.where(small, 1 - s / 6 + s * s / 120, np.sin(c) / safe)  # ∫ cos
    versine = np.where(small, c * (0.5 - s / 24 + s * s / 720), (1 - np.cos(c)) / safe)  # ∫ sin
    sine_slope = np.where(small, -c * (1 / 3 - s / 30 + s * s / 840), (np.cos(c) - sine) / safe)
    versine_slope = np.where(small, 0.5 - s / 8 + s * s / 144, (np.sin(c) - versine) / safe)
    angle = np.concatenate([[0.0], np.cumsum(c)])
    cos, sin = np.cos(angle[:-1]), np.sin(angle[:-1])
    forward, left = sine * a - versine * b, versine * a + sine * b
    x, y = cos * forward - sin * left, sin * forward + cos * left
    poses = np.zeros((len(twists) + 1, 3))
    poses[1:, 0], poses[1:, 1], poses[:, 2] = np.cumsum(x), np.cumsum(y), angle
    da, db, dc = np.moveaxis(slopes, 1, 0)
    turned = np.concatenate([np.zeros((1, slopes.shape[2])), np.cumsum(dc, axis=0)])
    f = (sine[:, None] * da - versine[:, None] * db) + (sine_slope * a - versine_slope * b)[:, None] * dc
    g = (versine[:, None] * da + sine[:, None] * db) + (versine_slope * a + sine_slope * b)[:, None] * dc
    result = np.zeros((len(twists) + 1, 3, slopes.shape[2]))
    result[1:, 0] = np.cumsum(cos[:, None] * f - sin[:, None] * g - y[:, None] * turned[:-1], axis=0)
    result[1:, 1] = np.cumsum(sin[:, None] * f + cos[:, None] * g + x[:, None] * turned[:-1], axis=0)
    result[:, 2] = turned
    return DrivenPath(poses, result)


def _planar_transforms(poses: Array) -> tuple[Array, Array]:
    """Return the transforms (N, 4, 4) of planar poses, and their derivatives (N, 3, 4, 4)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    transforms = np.zeros((len(poses), 4, 4))
    transforms[:, 0, 0], transforms[:, 0, 1], transforms[:, 1, 0], transforms[:, 1, 1] = c, -s, s, c
    transforms[:, 2, 2] = transforms[:, 3, 3] = 1.0
    transforms[:, :2, 3] = poses[:, :2]
    slopes = np.zeros((len(poses), 3, 4, 4))
    slopes[:, 0, 0, 3] = slopes[:, 1, 1, 3] = 1.0
    slopes[:, 2, 0, 0], slopes[:, 2, 0, 1], slopes[:, 2, 1, 0], slopes[:, 2, 1, 1] = -s, -c, c, -s
    return transforms, slopes


# -- residuals -------------------------------------------------------------------------------------------


class _Drive(NamedTuple):
    """Integrated drive: poses of the frame at the start of the drive, and of the plane in the reference."""

    local: Array  # start_T_frame, (N, 4, 4)
    by_local: Array  # derivatives, (N, p, 4, 4)
    origin: Array  # reference_T_plane, (4, 4)
    by_origin: Array  # (p, 4, 4)

    def at(self, some: Indices) -> _Drive:
        """Return some of the poses, without derivatives."""
        return _Drive(self.local[some], self.by_local[some][:, :0], self.origin, self.by_origin[:0])


class _Residuals(NamedTuple):
    """Residuals (N, 6), and their derivatives by the planar starts (N, 6, 3) and the parameters (N, 6, p)."""

    values: Array
    by_start: Array
    by_parameters: Array


def _residuals(drive: _Drive, seen: Array, starts: Array) -> _Residuals:
    """Return the residuals of seen poses, given the start (N, 3) of the piece that each belongs to."""
    begun, by_start = _planar_transforms(starts)
    base = drive.origin @ begun
    by_begun = drive.origin @ by_start @ drive.local[:, None]
    by_rest = base[:, None] @ drive.by_local + drive.by_origin @ (begun @ drive.local)[:, None]
    residual, jacobian = _pose_errors(seen, base @ drive.local, np.concatenate([by_begun, by_rest], axis=1))
    return _Residuals(residual, jacobian[..., :3], jacobian[..., 3:])


def _pose_errors(seen: Array, predicted: Array, slopes: Array) -> tuple[Array, Array]:
    """Return errors of poses (N, 6), and their derivatives (N, 6, p) given those of the predictions."""
    turned = log_so3(seen[:, :3, :3] @ np.swapaxes(predicted[:, :3, :3], 1, 2))
    spins = slopes[..., :3, :3] @ np.swapaxes(predicted[:, None, :3, :3], 2, 3)
    spin = np.stack([spins[..., 2, 1], spins[..., 0, 2], spins[..., 1, 0]], axis=1)
    shift = np.swapaxes(slopes[..., :3, 3], 1, 2)
    errors = np.concatenate([seen[:, :3, 3] - predicted[:, :3, 3], turned], axis=1)
    return errors, np.concatenate([-shift, -inverse_right_jacobian(turned) @ spin], axis=1)


class OdometryBlock:
    """Residuals of the poses seen along a drive."""

    groups = (NoiseGroup("position", "m", slice(0, 3)), NoiseGroup("orientation", "rad", slice(3, 6)))

    def __init__(
        self,
        given: WheelOdometry,
        model: ModelView,
        record: Articulation,
        free: tuple[Symbol, ...],
        look: int,
    ) -> None:
        self._readings = _Readings.of(given, record)
        frame = given.frame or record.child
        self.label = f"{frame} along a drive of {given.base}"
        self._poses = _check_poses(self.label, given.poses, len(self._readings.seen))
        self.looks = look + np.arange(len(self._poses))
        stated = None if given.covariance is None else check_covariance(given.covariance, 6, self.label)
        self.covariance = None if stated is None else np.broadcast_to(stated, (len(self._poses), 6, 6))
        self._compile(given, model, record, frame, free)
        self._weights = np.ones(6) if stated is None else 1.0 / np.sqrt(np.diag(stated))
        self.start: Array | None = None
        self.pieces, self.kept = [np.arange(len(self._poses))], np.ones(len(self._poses), dtype=bool)
        self._cut(given.restart)

    def _compile(
        self,
        given: WheelOdometry,
        model: ModelView,
        record: Articulation,
        frame: str,
        free: tuple[Symbol, ...],
    ) -> None:
        x, y, angle = plane = record.coordinates[:3]
        rows = [model.rates[c] for c in plane]
        twist = array([[as_expression(row.get(s, 0.0)) for s in record.speeds] for row in rows])
        origin = model.fk(record.child, relative_to=given.relative_to)
        mount = model.fk(frame, relative_to=record.child)
        moving = {*plane}
        if moving & {*mount.symbols} or not moving <= {*origin.symbols}:
            raise InvalidValueError(
                f"'{given.base}' does not move '{frame}' relative to '{given.relative_to}': frame= is one on "
                "the base, and relative_to= one beside it."
            )
        parts = [e.substitute({x: 0.0, y: 0.0, angle: 0.0}) for e in (twist, origin, mount)]
        used = {s for e in parts for s in e.symbols}
        self.parameters = tuple(s for s in free if s in used)
        self._present = np.array([s.value or 0.0 for s in self.parameters])
        series = [s for s in record.coordinates[3:] if s in used]
        state = given.state if isinstance(given.state, State) else State(given.state)
        fixed = sorted(used - {*self.parameters, *series}, key=lambda s: s.sort_key)
        lacking = [str(s) for s in fixed if s not in state and s.value is None]
        if lacking:
            raise UnknownNameError(
                f"{self.label} depends on {list_some(map(repr, lacking), 4)}, which its state= lacks."
            )
        known = {s: float(state.get(s, s.value)) for s in fixed}  # type: ignore[arg-type]
        parts = [e.substitute(known) for e in parts]
        slopes = [e.partial([*self.parameters]) for e in parts]
        self._function = compile([*parts, *slopes], [*self.parameters, *series])
        columns = [self._readings.middles[s] for s in series]
        self._columns = np.stack(columns, axis=1) if columns else np.zeros((1, 0))

    # -- evaluation ------------------------------------------------------------------------------------------

    def _drive(self, values: Array) -> _Drive:
        """Integrate the drive."""
        increments, seen, p = self._readings.increments, self._readings.seen, len(self.parameters)
        count, rows = len(increments), len(self._columns)
        inputs = np.concatenate([np.tile(values, (rows, 1)), self._columns], axis=1)
        twists, origin, mounts, by_twist, by_origin, by_mount = map(np.asarray, self._function.batch(inputs))
        by_twist = np.broadcast_to(by_twist, (count, *by_twist.shape[1:]))
        path = integrate_arcs(
            np.einsum("kim,km->ki", np.broadcast_to(twists, (count, *twists.shape[1:])), increments),
            np.einsum("kimp,km->kip", by_twist, increments),
        )
        at = np.zeros(len(seen), dtype=int) if rows == 1 else np.maximum(seen - 1, 0)
        moved, by_path = _planar_transforms(path.poses[seen])
        by_moved = (path.slopes[seen].transpose(0, 2, 1) @ by_path.reshape(-1, 3, 16)).reshape(-1, p, 4, 4)
        by_local = by_moved @ mounts[at][:, None] + moved[:, None] @ np.moveaxis(by_mount[at], 3, 1)
        return _Drive(moved @ mounts[at], by_local, origin[0], np.moveaxis(by_origin[0], 2, 0))

    def evaluate(self, values: Array) -> tuple[Array, Array]:
        """Return residuals (N, 6) and their Jacobian (N, 6, p), with the best start of each piece."""
        drive = self._drive(np.asarray(values, dtype=float))
        starts = np.empty((len(self._poses), 3))
        for piece in self.pieces:
            starts[piece] = self._start(drive, self._used(piece))
        found = _residuals(drive, self._poses, starts)
        jacobian = found.by_parameters.copy()
        for piece in self.pieces:
            used = self._used(piece)
            a = (found.by_start[used] * self._weights[:, None]).reshape(-1, 3)
            b = (found.by_parameters[used] * self._weights[:, None]).reshape(len(a), -1)
            jacobian[piece] -= found.by_start[piece] @ np.linalg.lstsq(a, b, rcond=None)[0]
        return found.values, jacobian

    def _used(self, piece: Indices) -> Indices:
        """Return the poses of a piece that its start is computed from."""
        used = piece[self.kept[piece]]
        return used if len(used) else piece

    def _start(self, drive: _Drive, used: Indices) -> Array:
        """Return the planar start that fits some poses best, from the one that fits their middle one."""
        k = int(used[len(used) // 2])
        there = inverse(drive.origin) @ self._poses[k] @ inverse(drive.local[k])
        start = np.array([there[0, 3], there[1, 3], math.atan2(there[1, 0], there[0, 0])])
        part = drive.at(used)
        for _ in range(_STARTS):
            found = _residuals(part, self._poses[used], np.tile(start, (len(used), 1)))
            a = (found.by_start * self._weights[:, None]).reshape(-1, 3)
            step = np.linalg.lstsq(a, -(found.values * self._weights).ravel(), rcond=None)[0]
            start = start + step
            if float(np.square(a @ step).sum()) < _SETTLED:
                break
        return start

    def log_outlier_density(self, outliers: Outliers) -> float:
        """Return the logarithm of the density of a gross error."""
        return outliers.log_uniform_density

    def scatter(self) -> Array:
        """Return the residuals (N, 6) of the best constant prediction."""
        rotations, places = self._poses[:, :3, :3], self._poses[:, :3, 3]
        turned = log_so3(rotations @ mean_rotation(rotations).T)
        return np.concatenate([places - places.mean(axis=0), turned], axis=1)

    # -- slips and gross errors --------------------------------------------------------------------------

    def _cut(self, restart: float | None) -> None:
        """Divide the drive into pieces without slip, and mark gross errors.

        The motion from a pose to the next one, which neither the start nor earlier slips change, is fitted
        first, with Cauchy weights. A pose that does not fit the last good one is a gross error; several in
        succession that fit each other are good ones after a slip. Slips that are too small for this are found
        by the likelihood ratio of a further start, over all poses of a piece.
        """
        values, drive = self._fit_motions()
        pieces: list[list[int]] = [[0]]
        kept = self.kept
        good, before, doubted, begun = 0, -1, list[int](), float(self._readings.seen_at[0])
        for k in range(1, len(self._poses)):
            now = float(self._readings.seen_at[k])
            if restart is not None and now - begun > restart:
                pieces[-1] += doubted
                pieces.append([k])
                good, before, doubted, begun = k, -1, [], now
                continue
            if self._fits(drive, good, k):
                pieces[-1] += [*doubted, k]
                kept[doubted] = False
                good, before, doubted = k, good, []
                continue
            if doubted and not self._fits(drive, doubted[-1], k):
                pieces[-1] += doubted
                kept[doubted] = False
                doubted = []
            doubted.append(k)
            if len(doubted) == _PERSISTENT:
                if before >= 0 and self._fits(drive, before, k):
                    kept[good] = False  # it was that one, which fitted by chance
                    pieces[-1] += doubted
                else:
                    begun = float(self._readings.seen_at[doubted[0]])
                    pieces.append(doubted)
                good, before, doubted = k, doubted[-2], []
        pieces[-1] += doubted
        kept[doubted] = False
        self.pieces = [np.array(piece) for piece in pieces]
        for _ in range(2):  # what was doubted before the last slip was found may be good
            while self._split_once(values):
                pass
            squares = np.square(self.evaluate(values)[0] * self._weights).sum(axis=1)
            self.kept[:] = squares < CHI_SQUARED_6
        self.start = values

    def _split_once(self, values: Array) -> bool:
        """Divide a piece where a further start improves the fit the most; return False if none does."""
        np.copyto(values, self._fit_pieces(values))
        drive, starts = self._drive(values), np.empty((len(self._poses), 3))
        for piece in self.pieces:
            starts[piece] = self._start(drive, self._used(piece))
        found = _residuals(drive, self._poses, starts)
        weights = self._weights * self.kept[:, None]
        by_start = found.by_start * weights[..., None]
        columns = [(found.by_parameters * weights[..., None]).reshape(len(weights) * 6, -1)]
        for piece in self.pieces:
            own = np.zeros_like(by_start)
            own[piece] = by_start[piece]
            columns.append(own.reshape(-1, 3))
        basis = np.linalg.svd(np.concatenate(columns, axis=1), full_matrices=False)
        told = basis[0][:, basis[1] > 1e-9 * basis[1][0]]
        whole = (found.values * weights).ravel()
        residual = (whole - told @ (told.T @ whole)).reshape(-1, 6)
        told = told.reshape(len(weights), 6, -1)
        best, where, which = _SLIP, 0, -1
        for n, piece in enumerate(self.pieces):
            if len(piece) < 2 * _PERSISTENT:
                continue
            s, after = by_start[piece], slice(None, None, -1)  # sums over all poses from one on
            gain = np.einsum("kia,ki->ka", s, residual[piece])[after].cumsum(axis=0)[after]
            shared = np.einsum("kiq,kia->kqa", told[piece], s)[after].cumsum(axis=0)[after]
            information = np.einsum("kia,kib->kab", s, s)[after].cumsum(axis=0)[after]
            information = information - np.swapaxes(shared, 1, 2) @ shared
            some = slice(_PERSISTENT, len(piece) - _PERSISTENT + 1)
            solved = np.linalg.pinv(information[some], rcond=1e-9, hermitian=True) @ gain[some, :, None]
            ratios = (gain[some] * solved[..., 0]).sum(axis=1)
            if ratios.max() > best:
                best, where, which = float(ratios.max()), _PERSISTENT + int(ratios.argmax()), n
        if which < 0:
            return False
        piece = self.pieces[which]
        self.pieces[which : which + 1] = [piece[:where], piece[where:]]
        return True

    def _fit_pieces(self, values: Array) -> Array:
        """Fit the parameters to the poses that are kept."""
        for _ in range(_STARTS):
            residual, jacobian = self.evaluate(values)
            weights = self._weights * self.kept[:, None]
            a = (jacobian * weights[..., None]).reshape(len(weights) * 6, -1)
            step = self._held_step(a, (residual * weights).ravel(), values)
            values = values + step
            if float(np.square(a @ step).sum()) < 1e-2:
                break
        return values

    def _held_step(self, jacobian: Array, residual: Array, values: Array) -> Array:
        """Return a Gauss-Newton step in which prior sizes hold what the data do not tell.

        These are 1 m and 1 rad for corrections, and the present values of other parameters.
        """
        information = np.diag(1.0 / np.where(self._present == 0.0, 1.0, self._present) ** 2)
        held = information @ (self._present - values)
        step = np.linalg.solve(jacobian.T @ jacobian + information, held - jacobian.T @ residual)
        return np.asarray(step, dtype=float)

    def _fits(self, drive: _Drive, a: int, b: int) -> bool:
        """Return True if the motion between two poses is that of the wheels."""
        ends = np.array([a]), np.array([b])
        errors, _ = _motion_errors(drive, self._poses, *ends)
        deviations = _motion_deviations(drive, 1.0 / self._weights, *ends)
        return float(np.square(errors / deviations).sum()) < CHI_SQUARED_6

    def _fit_motions(self) -> tuple[Array, _Drive]:
        """Fit the motions between successive poses, and with them the noise of a pose unless it is known."""
        values = self._present.copy()
        drive = self._drive(values)
        if len(self._poses) < 2:
            return values, drive
        ends = np.arange(len(self._poses) - 1), np.arange(1, len(self._poses))
        for _ in range(_ROBUST_STEPS):
            errors, jacobian = _motion_errors(drive, self._poses, *ends)
            # While the parameters are off, so are the motions, and the known noise would weigh all down.
            noise = _pose_noise(errors, drive, *ends)
            if self.covariance is None:
                self._weights = 1.0 / noise
            deviations = _motion_deviations(drive, noise, *ends)
            cauchy = 7.0 / (1.0 + np.square(errors / deviations).sum(axis=1))
            scale = np.sqrt(cauchy)[:, None] / deviations
            a = (jacobian * scale[..., None]).reshape(len(scale) * 6, -1)
            step = self._held_step(a, (errors * scale).ravel(), values)
            values = values + step
            drive = self._drive(values)
            if float(np.square(a @ step).sum()) < 1e-2:
                break
        return values, drive


def _motion_errors(drive: _Drive, seen: Array, a: Indices, b: Indices) -> tuple[Array, Array]:
    """Return the errors of motions from poses a to b, in axes of a, (n, 6), and their derivatives."""
    back = inverse(drive.local[a])
    predicted = back @ drive.local[b]
    slopes = back[:, None] @ (drive.by_local[b] - drive.by_local[a] @ predicted[:, None])
    return _pose_errors(inverse(seen[a]) @ seen[b], predicted, slopes)


def _motion_deviations(drive: _Drive, noise: Array, a: Indices, b: Indices) -> Array:
    """Return the standard deviations (n, 6) of motions between two noisy poses.

    That of the position grows with the distance by the first orientation, across it: in two axes of three.
    """
    place = np.sqrt(2.0 * noise[0] ** 2 + _squared_distances(drive, a, b) * (noise[3] ** 2 * 2 / 3))
    turn = np.full(len(place), math.sqrt(2.0) * noise[3])
    return np.stack([place, turn], axis=1).repeat(3, axis=1)


def _squared_distances(drive: _Drive, a: Indices, b: Indices) -> Array:
    result: Array = np.square((inverse(drive.local[a]) @ drive.local[b])[:, :3, 3]).sum(axis=1)
    return result


def _pose_noise(errors: Array, drive: _Drive, a: Indices, b: Indices) -> Array:
    """Return the standard deviations (6,) of one pose by the medians of the errors of motions."""
    squares = np.square(errors)
    turn = max(float(np.median(squares[:, 3:].sum(axis=1))) / _MEDIAN / 2.0, _FINEST**2)
    place = squares[:, :3].sum(axis=1)
    by_turn = turn * 2 / 3 * _squared_distances(drive, a, b)
    low, high = _FINEST, max(math.sqrt(float(np.median(place))), 2.0 * _FINEST)
    while high > 1.01 * low:
        middle = math.sqrt(low * high)
        above = float(np.median(place / (2.0 * middle**2 + by_turn))) > _MEDIAN
        low, high = (middle, high) if above else (low, middle)
    return np.repeat([high, math.sqrt(turn)], 3)


def _check_poses(what: str, given: npt.ArrayLike, count: int) -> Array:
    try:
        poses = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise ShapeError(f"{what}: poses are an array ({count}, 4, 4).") from None
    if poses.shape != (count, 4, 4):
        raise ShapeError(
            f"{what}: poses of shape ({count}, 4, 4) are expected, one for each time of seen_at, not of "
            f"shape {poses.shape}."
        )
    check_rigid(poses, what)
    return poses
