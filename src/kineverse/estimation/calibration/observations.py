"""Looks of a calibration: joint values with what was seen at them, and residuals of both.

A look is a state and observations: poses, points and pixels of frames, and values of expressions. Those of
one kind make a :class:`ResidualBlock`, whose residuals and Jacobian one compiled function computes for all.
Other recordings, such as odometry, take part by a block of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import (
    InvalidValueError,
    KineverseError,
    ShapeError,
    UnknownNameError,
    list_some,
    suggest,
)
from kineverse.estimation.noise import (
    UNKNOWN_NOISE,
    Outliers,
    as_numbers,
    check_covariance,
    check_finite,
    check_rigid,
)
from kineverse.estimation.tracking.measurements import (
    ObservedExpression,
    ObservedPose,
    ObservedPosition,
    require_covariance,
    wrap_difference,
)
from kineverse.expressions.expression import Expression, ExpressionLike, array, as_expression
from kineverse.lie import Array, log_so3, mean_rotation, orthonormalize
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.spatial import log_so3 as log_rotation
from kineverse.spatial import skew
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol, parameter


@dataclass(frozen=True, eq=False)
class ObservedPixel:
    """Observed pixel of a point in the image of a camera without distortion.

    The camera's frame has z forward, x to the right and y down in the image. A point (x, y, z) in it has the
    pixel (f_x x/z + c_x, f_y y/z + c_y).

    Attributes
    ----------
    frame, point
        The point (3,) [m] in coordinates of a frame; its origin by default.
    camera
        Frame of the camera.
    pixel
        The observed pixel (u, v) [px].
    focal, centre
        (f_x, f_y) and (c_x, c_y) [px], numbers, or parameters that can be free.
    covariance
        2×2 [px²], or the two variances; estimated from the data by default.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> pixel = kv.estimation.ObservedPixel(
    ...     "fetch/gripper_link",
    ...     camera="fetch/head_camera_rgb_optical_frame",
    ...     pixel=(312.0, 240.5),
    ...     focal=(550, 550),
    ...     centre=(320, 240),
    ... )
    >>> look = kv.estimation.Look(model.default_state(), [pixel])  # for calibrate()
    """

    frame: str
    camera: str
    pixel: tuple[float, float]
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    focal: tuple[ExpressionLike, ExpressionLike] = (1.0, 1.0)
    centre: tuple[ExpressionLike, ExpressionLike] = (0.0, 0.0)
    covariance: npt.ArrayLike | None = None


Observed: TypeAlias = "str | tuple[str, str] | ObservedPose | ObservedPosition | ObservedExpression"
Observations: TypeAlias = (
    "Mapping[Observed, npt.ArrayLike] | Sequence[ObservedPixel | tuple[Observed, npt.ArrayLike]]"
)


@dataclass(frozen=True, eq=False)
class Look:
    """Joint values, and what was seen at them.

    Attributes
    ----------
    state
        Values of the coordinates that the observations depend on [m], [rad], by symbol or name.
    observations
        Observed values by what was observed: a 4×4 pose by the name of its frame, or by a pair (frame,
        reference); any value by :class:`ObservedPose`, :class:`ObservedPosition` or
        :class:`ObservedExpression`, which follows its own parameters only and no corrections. Or a list of
        such pairs, and of :class:`ObservedPixel`.

    See Also
    --------
    kineverse.estimation.calibrate
    """

    state: StateLike
    observations: Observations


class NoiseGroup(NamedTuple):
    """Rows of a residual with one size of noise.

    See Also
    --------
    kineverse.estimation.calibrate
    """

    name: str  # groups of one name have the same size in all blocks
    unit: str  # m, rad or px
    rows: slice
    median: float | None = None  # of its unknown size, log-normal with a factor of 5; None for any size


class ResidualBlock(Protocol):
    """Residuals of N observations of one kind, as a function of the free parameters.

    See Also
    --------
    kineverse.estimation.calibrate
    """

    @property
    def label(self) -> str:
        """Words for what was observed."""

    @property
    def parameters(self) -> tuple[Symbol, ...]:
        """Free symbols that the residuals depend on."""

    @property
    def looks(self) -> npt.NDArray[np.int_]:
        """Index of the look of each observation, (N,)."""

    @property
    def groups(self) -> tuple[NoiseGroup, ...]:
        """Parts of a residual by the size of their noise."""

    @property
    def covariance(self) -> Array | None:
        """Covariances (N, m, m); None for noise of an unknown size."""

    @property
    def start(self) -> Array | None:
        """Parameters near the best ones, if the recording tells them by itself."""

    def evaluate(self, values: Array) -> tuple[Array, Array]:
        """Return residuals (N, m), observed less predicted, and their Jacobian (N, m, p)."""
        ...

    def log_outlier_density(self, outliers: Outliers) -> float:
        """Return the logarithm of the density of a gross error."""
        ...

    def scatter(self) -> Array | None:
        """Return the residuals (N, m) of the best constant prediction; None if there is no such thing."""
        ...


@runtime_checkable
class BlockSource(Protocol):
    """Recording that makes a residual block of its own, such as odometry.

    See Also
    --------
    kineverse.estimation.WheelOdometry
    """

    def residual_block(self, model: ModelView, free: Sequence[Symbol], look: int) -> ResidualBlock:
        """Return the block.

        Parameters
        ----------
        model
            Model whose frames and rates are expressions of the free symbols.
        free
            All free symbols: the block names those that its residuals depend on.
        look
            Index of the recording among all; its observations count as this look, or as several ones.
        """
        ...


class Kernel(NamedTuple):
    """Compiled residual of one kind of observation, in columns of inputs: state, parameters, data."""

    function: CompiledFunction[
        tuple[Array, ...]
    ]  # residual (m,), Jacobian (m, p), and the pose (4, 4) if any
    coordinates: tuple[Symbol, ...]
    parameters: tuple[Symbol, ...]
    data: int  # number of inputs that are observed


@dataclass(eq=False)
class CompiledBlock:
    """Residual block of a compiled function."""

    label: str
    kind: str  # pose, position, pixel or expression
    kernel: Kernel
    looks: npt.NDArray[np.int_]
    inputs: Array  # (N, n)
    covariance: Array | None
    period: float = math.inf
    start: Array | None = None

    def __post_init__(self) -> None:
        self.parameters = self.kernel.parameters
        size = self.kernel.function.shapes[0][0]
        self.groups = _GROUPS.get(self.kind) or (NoiseGroup(self.label, "", slice(0, size)),)
        start = len(self.kernel.coordinates)
        self._columns = slice(start, start + len(self.parameters))

    @property
    def seen(self) -> Array:
        """Observed numbers, (N, d): a pose as its 12 numbers."""
        return self.inputs[:, self.inputs.shape[1] - self.kernel.data :]

    def evaluate(self, values: Array) -> tuple[Array, Array]:
        """Return residuals (N, m) and their Jacobian (N, m, p)."""
        self.inputs[:, self._columns] = values
        residual, jacobian, *_ = self.kernel.function.batch(self.inputs)
        return wrap_difference(residual, self.period), jacobian

    def poses(self, values: Array) -> Array:
        """Return the predicted poses (N, 4, 4)."""
        self.inputs[:, self._columns] = values
        return np.asarray(self.kernel.function.batch(self.inputs)[2])

    def twists(self, values: Array, poses: Array) -> Array:
        """Return the geometric Jacobian (N, 6, p) of predicted poses."""
        inputs = self.inputs.copy()
        inputs[:, self._columns] = values
        inputs[:, -self.kernel.data :] = poses[:, :3].reshape(-1, 12)
        return -np.asarray(self.kernel.function.batch(inputs)[1])

    def log_outlier_density(self, outliers: Outliers) -> float:
        """Return the logarithm of the density of a gross error."""
        if self.kind == "pose":
            return outliers.log_uniform_density
        if self.kind == "pixel":
            width, height = np.maximum(np.ptp(self.seen[:, :2], axis=0), 1.0)
            return -math.log(float(width * height))
        return -int(self.groups[0].rows.stop) * math.log(outliers.reach)

    def scatter(self) -> Array:
        """Return the residuals (N, m) of the best constant prediction."""
        seen = self.seen
        if self.kind == "pixel":
            return np.asarray(seen[:, :2] - seen[:, :2].mean(axis=0))
        if self.kind != "pose":
            seen = seen[:, : self.groups[0].rows.stop]
            return wrap_difference(seen - seen.mean(axis=0), self.period)
        poses = seen.reshape(-1, 3, 4)
        turned = log_so3(poses[:, :, :3] @ mean_rotation(poses[:, :, :3]).T)
        return np.concatenate([poses[:, :, 3] - poses[:, :, 3].mean(axis=0), turned], axis=1)


_GROUPS = {
    "pose": (
        NoiseGroup("position", "m", slice(0, 3), UNKNOWN_NOISE[0]),
        NoiseGroup("orientation", "rad", slice(3, 6), UNKNOWN_NOISE[1]),
    ),
    "position": (NoiseGroup("point", "m", slice(0, 3), UNKNOWN_NOISE[0]),),
    "pixel": (NoiseGroup("pixel", "px", slice(0, 2), 1.0),),
}


# -- residuals as expressions ----------------------------------------------------------------------------


def build_kernel(model: ModelView, key: tuple[Any, ...], free: Sequence[Symbol]) -> Kernel:
    """Compile the residual of a kind of observation, see :func:`_key`."""
    kind, *about = key
    residual, jacobian, data, pose = _BUILDERS[kind](model, free, *about)
    symbols = {*residual.symbols, *(() if pose is None else pose.symbols)}
    parameters = tuple(s for s in free if s in symbols)
    columns = [free.index(s) for s in parameters]
    outputs = [residual, jacobian[:, columns] if columns else np.zeros((len(residual), 0))]
    outputs += [] if pose is None else [pose]
    coordinates = tuple(sorted(symbols - set(free) - set(data), key=lambda s: s.sort_key))
    function = compile(outputs, [*coordinates, *parameters, *data])
    return Kernel(function, coordinates, parameters, len(data))


_Built: TypeAlias = tuple[Expression, Expression, list[Symbol], "Expression | None"]


def _data(count: int) -> list[Symbol]:
    return [parameter(f"calibration/observed/{i}", 0.0) for i in range(count)]


def _twists(
    model: ModelView, pose: Expression, frame: str, relative_to: str, free: Sequence[Symbol]
) -> Expression:
    """Return the geometric Jacobian (6, p) of a pose by free symbols, in axes of the reference."""
    geometric = model.jacobian(frame, relative_to, symbols=[s for s in free if s.has_derivative])
    result: list[Any] = []
    moving = 0
    for symbol in free:
        if symbol.has_derivative:
            result.append(geometric[:, moving])
            moving += 1
            continue
        slope = pose.partial([symbol])[:, :, 0]
        spin = slope[:3, :3] @ pose[:3, :3].T
        result.append(np.concatenate([slope[:3, 3], array([spin[2, 1], spin[0, 2], spin[1, 0]])]))
    return np.stack(result, axis=1)  # type: ignore[return-value]


def _pose(model: ModelView, free: Sequence[Symbol], frame: str, relative_to: str) -> _Built:
    pose, data = model.fk(frame, relative_to), _data(12)
    seen = array(data).reshape(3, 4)
    turned = log_rotation(seen[:, :3] @ pose[:3, :3].T)
    twists = _twists(model, pose, frame, relative_to, free)
    # log(S exp(-ω)) = log S - Jr⁻¹ ω; the series of Jr⁻¹ is right to 1e-4 up to half a radian, and for
    # isotropic noise the gradient is exact with any of it, because [r]× r = 0.
    across = skew(turned)
    turning = as_expression(np.eye(3)) + across / 2 + across @ across / 12
    residual = np.concatenate([seen[:, 3] - pose[:3, 3], turned])
    jacobian = np.concatenate([-twists[:3], -(turning @ twists[3:])])
    return residual, jacobian, data, pose  # type: ignore[return-value]


def _point_in(
    model: ModelView, free: Sequence[Symbol], frame: str, relative_to: str, point: Sequence[Symbol]
) -> tuple[Expression, Expression]:
    """Return a point of a frame in a reference (3,), and its Jacobian (3, p)."""
    pose = model.fk(frame, relative_to)
    twists = _twists(model, pose, frame, relative_to, free)
    arm = pose[:3, :3] @ array(list(point))
    return pose[:3, 3] + arm, twists[:3] - skew(arm) @ twists[3:]


def _position(model: ModelView, free: Sequence[Symbol], frame: str, relative_to: str) -> _Built:
    data = _data(6)
    place, jacobian = _point_in(model, free, frame, relative_to, data[3:])
    return array(data[:3]) - place, -jacobian, data, None


def _pixel(
    model: ModelView,
    free: Sequence[Symbol],
    frame: str,
    camera: str,
    focal: tuple[Expression, Expression],
    centre: tuple[Expression, Expression],
) -> _Built:
    data = _data(5)
    place, jacobian = _point_in(model, free, frame, camera, data[2:])
    x, y, z = place
    image = array([focal[0] * x / z + centre[0], focal[1] * y / z + centre[1]])
    zero = as_expression(0.0)
    by_place = array(
        [[focal[0] / z, zero, -focal[0] * x / (z * z)], [zero, focal[1] / z, -focal[1] * y / (z * z)]]
    )
    # Intrinsics may be free as well, in the image for a place that is held.
    held = array(list(_data(8)[5:]))
    direct = array([focal[0] * held[0] / held[2] + centre[0], focal[1] * held[1] / held[2] + centre[1]])
    by_intrinsics = direct.partial(list(free)).substitute(dict(zip(held, place, strict=True)))  # type: ignore[arg-type]
    return array(data[:2]) - image, -(by_place @ jacobian) - by_intrinsics, data, None


def _expression(
    model: ModelView, free: Sequence[Symbol], name: str, expression: Expression, period: float
) -> _Built:
    value = array(expression).reshape(-1)
    data = _data(len(value))
    return array(data) - value, -value.partial(list(free)), data, None


_BUILDERS: dict[str, Callable[..., _Built]] = {
    "pose": _pose,
    "position": _position,
    "pixel": _pixel,
    "expression": _expression,
}


# -- looks -------------------------------------------------------------------------------------------------


class ObservedRow(NamedTuple):
    """Observation of one look: key of its kind, label, observed numbers, and covariance."""

    key: tuple[Any, ...]
    label: str
    data: Array
    covariance: Array | None
    look: int


def read_look(
    model: ModelView, known: Mapping[str, Symbol], index: int, given: object
) -> tuple[State, list[ObservedRow]]:
    """Check a look, and return its state and observations; ``known`` are symbols by name."""
    if isinstance(given, Look):
        state, observations = given.state, given.observations
    else:
        try:
            state, observations = given  # type: ignore[misc]
        except (TypeError, ValueError):
            raise InvalidValueError(
                f"Look {index} is a pair (state, observations), kv.estimation.Look(state, observations) or "
                f"a recording with a residual block, not {given!r:.80}."
            ) from None
    if not isinstance(state, (State, Mapping)):
        raise InvalidValueError(
            f"The state of look {index} is a mapping {{joint: value}}, not {state!r:.60}."
        )
    try:
        values = state if isinstance(state, State) else State(_by_symbol(state, known))
    except KineverseError as error:
        raise InvalidValueError(f"The state of look {index} has no values for a model. {error}") from None
    items: Iterable[Any] = observations.items() if isinstance(observations, Mapping) else observations
    if isinstance(observations, (str, np.ndarray)) or not isinstance(items, Iterable):
        raise InvalidValueError(
            f"The observations of look {index} are a mapping {{frame: pose}} or a list, not {items!r:.80}."
        )
    rows = [_row(model, index, item) for item in items]
    if not rows:
        raise InvalidValueError(f"Look {index} has no observations; leave it out.")
    return values, rows


def _by_symbol(state: Mapping[Any, float], known: Mapping[str, Symbol]) -> dict[Any, float]:
    # Names of the model need not be parsed.
    result = {known.get(key, key): value for key, value in state.items()}
    return result if len(result) == len(state) else dict(state)


def _row(model: ModelView, look: int, item: Any) -> ObservedRow:
    if isinstance(item, ObservedPixel):
        return _pixel_row(model, look, item)
    try:
        what, value = item
    except (TypeError, ValueError):
        raise InvalidValueError(
            f"An observation of look {look} is ObservedPixel or a pair (what, value), not {item!r:.80}."
        ) from None
    if isinstance(what, str):
        what = ObservedPose(what)
    elif isinstance(what, tuple) and len(what) == 2 and all(isinstance(name, str) for name in what):
        what = ObservedPose(what[0], relative_to=what[1])
    part = "observation"
    if isinstance(what, ObservedExpression):
        expression = array(what.expression)
        size = 1 if not expression.shape else expression.shape[0]
        part = f"value of '{what.name}' in look {look}"
        numbers = as_numbers(value, f"The {part}").reshape(-1)
        if len(numbers) != size:
            raise ShapeError(f"The {part} has {size} numbers, not {len(numbers)}.")
        period = math.inf if what.period is None else float(what.period)
        key: tuple[Any, ...] = ("expression", what.name, expression, period)
        covariance = require_covariance(what.covariance, size, what.name)
        return ObservedRow(key, what.name, numbers, covariance, look)
    if not isinstance(what, (ObservedPose, ObservedPosition)):
        raise InvalidValueError(
            f"Look {look} observes names of frames, pairs (frame, reference), ObservedPose, "
            f"ObservedPosition, ObservedExpression or ObservedPixel, not {what!r:.80}."
        )
    _check_frames(model, look, what.frame, what.relative_to)
    label = what.name or (what.frame if what.relative_to == WORLD else f"{what.frame} in {what.relative_to}")
    part = f"'{label}' in look {look}"
    data = as_numbers(value, f"The value of {part}")
    if isinstance(what, ObservedPosition):
        if data.shape != (3,):
            raise ShapeError(f"The position of {part} is three numbers [m], not of shape {data.shape}.")
        given = None if what.covariance is None else check_covariance(what.covariance, 3, part)
        point = np.asarray(what.point, dtype=float)
        if point.shape != (3,):
            raise ShapeError(f"The point of {part} is three numbers [m], not {what.point!r}.")
        key = ("position", what.frame, what.relative_to)
        return ObservedRow(key, label, np.concatenate([data, point]), given, look)
    if data.shape != (4, 4):
        hint = " A point is seen by ObservedPosition." if data.shape == (3,) else ""
        raise ShapeError(f"The pose of {part} is a 4×4 matrix, not of shape {data.shape}.{hint}")
    given = None if what.covariance is None else check_covariance(what.covariance, 6, part)
    return ObservedRow(("pose", what.frame, what.relative_to), label, data, given, look)


def _pixel_row(model: ModelView, look: int, item: ObservedPixel) -> ObservedRow:
    _check_frames(model, look, item.frame, item.camera)
    label = f"{item.frame} in the image of {item.camera}"
    part = f"{label}, look {look}"
    try:
        numbers = np.array([*item.pixel, *item.point], dtype=float)
        focal, centre = (tuple(map(as_expression, pair)) for pair in (item.focal, item.centre))
    except (TypeError, ValueError):
        raise InvalidValueError(
            f"A pixel of {part} has pixel=(u, v), point=(x, y, z), focal=(fx, fy) and centre=(cx, cy)."
        ) from None
    if numbers.size != 5 or {len(focal), len(centre)} != {2}:
        raise ShapeError(
            f"A pixel of {part} has pixel=(u, v), point=(x, y, z), focal=(fx, fy) and centre=(cx, cy)."
        )
    covariance = None if item.covariance is None else check_covariance(item.covariance, 2, part)
    return ObservedRow(("pixel", item.frame, item.camera, focal, centre), label, numbers, covariance, look)


def _check_frames(model: ModelView, look: int, *frames: str) -> None:
    for name in frames:
        if name != WORLD and name not in model.frames:
            raise UnknownNameError(
                f"Look {look} observes frame '{name}', which the model does not have. "
                f"{suggest(str(name), model.frames, 'frame')}"
            )


def make_block(kernel: Kernel, rows: Sequence[ObservedRow], states: Mapping[int, State]) -> CompiledBlock:
    """Gather observations of one kind from all looks."""
    first = rows[0]
    inputs = np.zeros((len(rows), len(kernel.function.inputs)))
    for i, row in enumerate(rows):
        try:
            inputs[i, : len(kernel.coordinates)] = states[row.look].vector(kernel.coordinates)
        except UnknownNameError:
            state = states[row.look]
            missing = [str(s) for s in kernel.coordinates if s.value is None and state.given(s) is None]
            raise UnknownNameError(
                f"Look {row.look} has no value for {list_some(map(repr, missing), 12)}, which "
                f"'{row.label}' depends on. Its state has {list_some(map(repr, map(str, state)), 6)}."
            ) from None
    inputs[:, inputs.shape[1] - kernel.data :] = _stack(rows)
    # Rows with and without a covariance are in different blocks.
    covariance = None if first.covariance is None else np.array([row.covariance for row in rows])
    looks = np.array([row.look for row in rows])
    wrong = np.flatnonzero(~np.isfinite(inputs).all(axis=1))
    if len(wrong):
        raise InvalidValueError(f"The state of look {looks[wrong[0]]} has a value that is not finite.")
    period = first.key[3] if first.key[0] == "expression" else math.inf
    return CompiledBlock(first.label, first.key[0], kernel, looks, inputs, covariance, period)


def _stack(rows: Sequence[ObservedRow]) -> Array:
    """Return the observed numbers of all rows, after a check of them."""
    seen = np.stack([row.data for row in rows])
    is_pose = rows[0].key[0] == "pose"
    try:
        check_rigid(seen, "") if is_pose else check_finite(seen, "")
    except InvalidValueError:
        for row in rows:  # which one it is
            part = f"observation '{row.label}' in look {row.look}"
            check_rigid(row.data[None], part) if is_pose else check_finite(row.data[None], part, "Value")
    return np.asarray(orthonormalize(seen))[:, :3].reshape(-1, 12) if is_pose else seen
