"""Calibration of a model from recordings."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count, as_positive
from kineverse._rich_display import TableDisplay, element, html_table
from kineverse.errors import DuplicateNameError, InvalidValueError, UnknownNameError, list_some, suggest
from kineverse.estimation.noise import Outliers, as_outliers
from kineverse.formats.saver import save_corrections
from kineverse.lie import Array
from kineverse.model.edit import Edit
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse.model.registry import SaveResult
from kineverse.state import State
from kineverse.symbols import Symbol, parameter

from .corrections import (
    Correction,
    corrected_operation,
    find_corrections,
    parameterised_operation,
    with_parameters,
)
from .hand_eye import start_mounts
from .observations import (
    CompiledBlock,
    Kernel,
    ObservedRow,
    ResidualBlock,
    build_kernel,
    make_block,
    read_look,
)
from .solver import (
    CalibrationFit,
    CalibrationProblem,
    Linearised,
    check_explained,
    check_residuals,
    pseudo_inverse,
)

Mask: TypeAlias = "npt.NDArray[np.bool_]"

_PRIOR = {"m": 1.0, "rad": 1.0}  # prior sizes of corrections, the scale in which directions are compared
_SHOWN = 0.05  # least coefficient of a direction that is printed


class Outlier(NamedTuple):
    """Observation that the calibration takes for a gross error."""

    look: int
    what: str  # label of the observation
    probability: float  # that it is an inlier


class _Unknown(NamedTuple):
    """Free parameter."""

    inner: Symbol  # in the expressions of the calibration
    outer: Symbol  # in the result
    unit: str
    scale: float  # prior size


@dataclass(eq=False)
class _Prepared:
    """Model with corrections as expressions, and what was compiled of it."""

    corrections: list[Correction]
    unknowns: list[_Unknown]
    model: Model
    names: dict[str, Symbol]  # symbols of the model by name
    kernels: dict[tuple[Any, ...], Kernel] = field(default_factory=dict)


_PREPARED: WeakKeyDictionary[Model, tuple[int, dict[tuple[Any, ...], _Prepared]]] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Calibration(TableDisplay):
    """Result of :func:`calibrate`: parameters, their uncertainty, and the corrected operations.

    Attributes
    ----------
    state
        Value of each free parameter, by symbol or name. Those of corrections, ``name/offset``, ``name/dx``
        and so on, are differences from the calibrated model [m], [rad]; free symbols have their values.
    covariance
        Covariance of the parameters in the order of ``state``, (p, p), of the directions that the data tell:
        with the others held where they were.
    deviations
        Standard deviation of each parameter by name, infinite for one that is uncertain mostly by its share
        in an unobservable direction.
    unobservable
        Directions that the data do not tell, each as {name: coefficient} of unit length in parameters scaled
        by their prior sizes, 1 m, 1 rad, or the present value of a free symbol. A direction is told if its
        standard deviation is below 1 in this scale.
    noise
        Standard deviation of each component of an observation, by group: ``position`` [m] and ``orientation``
        [rad] of poses, ``point`` [m], ``pixel`` [px]. Given ones as they are.
    outliers
        Observations that are gross errors more probably than not.
    before, held_out
        RMS of the length of the residuals by group, of inliers: by the model before, and of looks that were
        left out, each in one of several parts, by the model from the others.
    looks
        Number of looks.

    See Also
    --------
    kineverse.estimation.calibrate
    """

    state: State
    covariance: Array
    deviations: Mapping[str, float]
    unobservable: tuple[Mapping[str, float], ...]
    noise: Mapping[str, float]
    outliers: tuple[Outlier, ...]
    before: Mapping[str, float]
    held_out: Mapping[str, float]
    looks: int
    units: Mapping[str, str]
    calibrated: Mapping[str, Operation] = field(repr=False)  # operations before, by tag
    model: Model = field(repr=False)  # the model that was calibrated
    corrections: tuple[Correction, ...] = field(repr=False)

    @cached_property
    def operations(self) -> Mapping[str, Operation]:
        """Corrected operations by tag."""
        values = [self.state.vector([parameter(s.path, 0.0) for s in c.symbols]) for c in self.corrections]
        new = {s: parameter(s.path, v) for s, v in self.state.items() if not self.units[str(s)]}
        result = {}
        for tag, operation in self.calibrated.items():
            own = [i for i, correction in enumerate(self.corrections) if correction.tag == tag]
            numbers = [values[i].tolist() for i in own]
            corrected = corrected_operation(operation, [self.corrections[i] for i in own], numbers)
            result[tag] = with_parameters(corrected, new)
        return result

    def apply(self, model: Model) -> int:
        """Replace the operations of a model by the corrected ones, in one edit; return its new version.

        Raises
        ------
        InvalidValueError
            If the model's operations are not those that were calibrated, as after a first ``apply``, or a
            free symbol stands in an operation without its class.
        """
        for tag, operation in self.calibrated.items():
            entry = model.history.entries.get(tag)
            if entry is None or entry.operation != operation:
                how = "is missing" if entry is None else "has changed since the calibration"
                raise InvalidValueError(
                    f"The calibration does not fit this model: its operation {tag!r} {how}. Calibrate the "
                    "model as it is now, or undo the change."
                )
        old = [s for s in self.state if not self.units[str(s)]]
        with model.edit() as edit:
            self.write(edit)
            left = [str(s) for s in old if s in edit.model.symbols and s.value != self.state[s]]
            if left:
                raise InvalidValueError(
                    f"The value of {list_some(map(repr, left), 4)} cannot be set in this model: it stands in "
                    "operations of a document without their classes. Pass calibration.state with the values."
                )
        return model.version

    def save(
        self, path: str | os.PathLike[str], *, source: str | os.PathLike[str] | None = None
    ) -> SaveResult:
        """Write the corrected model to a file, in the format of its ending.

        A URDF is the file that the model was loaded from, or ``source``, with other numbers for corrected
        origins and axes; all its other bytes are as they were. The remarks say what it has no number for,
        such as the radius of a wheel. A document (``.kv.json``) holds all corrections.

        A URDF that is a template of xacro, has changed since it was loaded, or is not that of the model is
        refused, and so is a model that was edited since at what is corrected.
        """
        corrected = self.model.copy()
        self.apply(corrected)
        return save_corrections(corrected, self.calibrated, self.operations, path, source)

    def write(self, edit: Edit) -> None:
        """Replace the operations within an edit."""
        for tag, operation in self.operations.items():
            edit.replace(tag, operation)

    def __str__(self) -> str:
        lines = [f"Calibration of {len(self.state)} parameters from {self.looks} looks"]
        width = max(map(len, self.deviations))
        for symbol, value in self.state.items():
            name = str(symbol)
            deviation = self.deviations[name]
            lines.append(f"  {name:<{width}}  {_format(value, deviation, self.units[name])}")
        for group, size in self.noise.items():
            parts = [f"noise {format_size(size, group)}"]
            if group in self.before:
                parts.append(f"off by {format_size(self.before[group], group)} before")
            if group in self.held_out:
                parts.append(f"a look not used is off by {format_size(self.held_out[group], group)}")
            lines.append(f"{group}: {', '.join(parts)}")
        if self.outliers:
            looks = sorted({outlier.look for outlier in self.outliers})
            errors = "1 gross error" if len(self.outliers) == 1 else f"{len(self.outliers)} gross errors"
            lines.append(f"{errors}, in {'look' if len(looks) == 1 else 'looks'} {list_some(looks, 12)}")
        alone = [name for one in self.unobservable if len(one) == 1 for name in one]
        lines += [f"not told by the data: {', '.join(alone)}"] if alone else []
        lines += [f"not told by the data: {format_direction(d)}" for d in self.unobservable if len(d) > 1]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = [
            (str(s), _format(value, self.deviations[str(s)], self.units[str(s)]))
            for s, value in self.state.items()
        ]
        caption, *rest = str(self).splitlines()
        return element(
            "div",
            html_table(caption, ("parameter", "value"), rows),
            *(element("p", line) for line in rest[len(rows) :]),
        )


def format_direction(direction: Mapping[str, float]) -> str:
    """Return an unobservable direction as text, the largest coefficient first."""
    largest = sorted(direction.items(), key=lambda item: -abs(item[1]))
    return ", ".join(f"{name} {value:.2f}" for name, value in largest if abs(value) >= _SHOWN)


SHOWN_UNITS = {"m": (1e3, "mm"), "rad": (180 / math.pi, "deg")}
_GROUP_UNITS = {"position": "m", "point": "m", "orientation": "rad", "pixel": "px"}


def _format(value: float, deviation: float, unit: str) -> str:
    factor, shown = SHOWN_UNITS.get(unit, (1.0, unit))
    if math.isinf(deviation):
        return f"{factor * value:+.4g} {shown}".rstrip() + ", not told"
    return f"{factor * value:+.4g} ± {factor * deviation:.2g} {shown}".rstrip()


def format_size(size: float, group: str) -> str:
    """Return the size of a noise or an error of a group with its unit."""
    unit = _GROUP_UNITS.get(group, "")
    factor, shown = SHOWN_UNITS.get(unit, (1.0, unit))
    return f"{factor * size:.3g} {shown}".rstrip()


def calibrate(
    model: Model,
    recordings: Iterable[Any],
    free: Iterable[str | Symbol] | str | Symbol,
    *,
    noise: tuple[float, float] | Mapping[str, float] | None = None,
    outliers: Outliers | bool | None = True,
    held_out: int = 5,
) -> Calibration:
    """Return the corrections of a model that explain recordings best.

    Parameters
    ----------
    model
        Model to calibrate; it is not changed.
    recordings
        Looks, each :class:`Look` or a pair (state, observations), and other recordings with a residual block
        of their own.
    free
        What is free. Texts of a word and a pattern of names with ``*`` and ``?``: ``offsets arm/*`` (zeros of
        joints), ``mount camera`` (the pose of a joint or frame in its parent, six numbers), ``length
        arm/elbow`` (of the origin along its direction), ``axis arm/elbow`` (its direction, by two angles),
        ``wheels base`` (radii and track), ``pitch spindle``. Symbols of :func:`kineverse.parameter` in the
        model or in an observation.
    noise
        Standard deviations of a position [m] and an orientation [rad], or of groups by name; by default they
        are estimated from the recordings. An observation with a covariance keeps that.
    outliers
        Model of gross errors, None for none.
    held_out
        Number of parts in which looks are left out in turn, to measure the error of looks that are not used;
        0 to skip it.

    Raises
    ------
    UnknownNameError
        For names that the model does not have, and a look without a joint that an observation depends on.
    InvalidValueError
        For too few looks, values that are not finite, and recordings that the model does not explain.
    ShapeError
        For observations of the wrong shape.
    NoSolutionError
        If the steps do not converge.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> door = model.fk("kitchen/fridge_door")
    >>> seen = {q: door({"kitchen/fridge_door": q + 0.05}) for q in (0.1, 0.5, 0.9)}  # its zero is off
    >>> looks = [
    ...     kv.estimation.Look({"kitchen/fridge_door": q}, {"kitchen/fridge_door": pose})
    ...     for q, pose in seen.items()
    ... ]
    >>> result = kv.estimation.calibrate(
    ...     model, looks, "offsets kitchen/fridge_door", noise=(0.001, 0.01), held_out=0
    ... )
    >>> round(result.state["kitchen/fridge_door/offset"], 4)
    0.05
    """
    if not isinstance(model, Model):
        raise InvalidValueError(f"A model is calibrated, as from kv.load(...), not {model!r:.60}.")
    kinds = as_outliers(outliers)
    folds = as_count("held_out", held_out, 0)
    if folds == 1:
        raise InvalidValueError("held_out is 0, or at least 2: of one part, no looks are left to fit.")
    if isinstance(recordings, Mapping | str) or not isinstance(recordings, Iterable):
        raise InvalidValueError(
            f"Recordings are a list of looks (state, observations), not {recordings!r:.60}."
        )
    prepared = _prepare(model, free)
    blocks = _make_blocks(model, prepared, list(recordings))
    unknowns = prepared.unknowns
    inner = [unknown.inner for unknown in unknowns]
    place = {symbol: i for i, symbol in enumerate(inner)}
    columns = [[place[s] for s in block.parameters] for block in blocks]
    scales = np.array([unknown.scale for unknown in unknowns])
    problem = CalibrationProblem(blocks, columns, scales, _stated_noise(noise, blocks), kinds)
    present = np.array([u.outer.value or 0.0 for u in unknowns])
    before = problem.linearise(present / scales)
    check_residuals(before, blocks)
    _check_count(problem, len(unknowns))
    if not any(len(one.jacobian) and one.jacobian.any() for one in before):
        raise InvalidValueError(
            "No observation depends on what is free: "
            f"{list_some((str(u.outer) for u in unknowns), 6)}. Free something between the observed frames."
        )
    starts = [start / scales for start in _starts(problem, prepared, place, present)]
    fit = problem.solve(starts, present / scales)
    sizes = ", ".join(format_size(size, name) for name, size in fit.noise.items())
    check_explained(problem, fit, sizes)
    return _result(model, prepared, problem, fit, before, folds)


def _prepare(model: Model, free: Iterable[str | Symbol] | str | Symbol) -> _Prepared:
    """Return the model with corrections as expressions; the last ones of a version are kept."""
    items = [free] if isinstance(free, (str, Symbol)) else list(free)
    for item in items:
        if not isinstance(item, str) and not (isinstance(item, Symbol) and item.role == "parameter"):
            raise InvalidValueError(
                f"free= has texts such as 'offsets arm/*' and symbols of kv.parameter, not {item!r:.60}."
            )
    if not items:
        raise InvalidValueError(
            "Nothing is free: free=['offsets arm/*', 'mount camera'] or the like is missing."
        )
    version, known = _PREPARED.get(model, (-1, {}))
    if version != model.version:
        known = {}
        _PREPARED[model] = model.version, known
    key = tuple(items)
    if key not in known:
        known[key] = _parameterise(model, items)
    return known[key]


def _parameterise(model: Model, items: Sequence[str | Symbol]) -> _Prepared:
    corrections = find_corrections(model, [item for item in items if isinstance(item, str)])
    unknowns = [
        _Unknown(s, parameter(s.path, 0.0), unit, _PRIOR[unit])
        for correction in corrections
        for s, unit in zip(correction.symbols, correction.units, strict=True)
    ]
    symbols = dict.fromkeys(item for item in items if isinstance(item, Symbol))
    unknowns += [_Unknown(s, s, "", abs(s.value or 0.0) or 1.0) for s in symbols]
    names = [str(unknown.outer) for unknown in unknowns]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DuplicateNameError(f"Two free parameters have the name '{twice[0]}'; rename that of the model.")
    scratch = model.copy()
    with scratch.edit() as edit:
        for tag, group in _by_tag(corrections).items():
            edit.replace(tag, parameterised_operation(model.history.operation(tag), group))
    return _Prepared(corrections, unknowns, scratch, {str(s): s for s in model.symbols})


def _by_tag(corrections: Iterable[Correction]) -> dict[str, list[Correction]]:
    result: dict[str, list[Correction]] = {}
    for correction in corrections:
        result.setdefault(correction.tag, []).append(correction)
    return result


def _make_blocks(model: Model, prepared: _Prepared, recordings: Sequence[Any]) -> list[ResidualBlock]:
    """Return the residual blocks of all recordings."""
    if not recordings:
        raise InvalidValueError("There are no looks. Each is a pair (state, observations).")
    inner = [unknown.inner for unknown in prepared.unknowns]
    states: dict[int, State] = {}
    rows: dict[tuple[Any, ...], list[ObservedRow]] = {}
    blocks: list[ResidualBlock] = []
    names = prepared.names
    for index, recording in enumerate(recordings):
        if hasattr(recording, "residual_block"):
            blocks.append(recording.residual_block(prepared.model, inner, index))
            continue
        state, seen = read_look(model, names, index, recording)
        states[index] = state
        for row in seen:
            rows.setdefault((*row.key, row.covariance is None), []).append(row)
    used: set[str] = set()
    for key, group in rows.items():
        kernel = prepared.kernels.get(key)
        if kernel is None:
            kernel = prepared.kernels[key] = build_kernel(prepared.model, key[:-1], inner)
        if key[0] == "expression" and not kernel.parameters:
            raise InvalidValueError(
                f"'{key[1]}' does not depend on what is free. An expression has its own parameters only: one "
                "made of a model's frames does not follow corrections of them. Observe the frame instead."
            )
        used.update(map(str, kernel.coordinates))
        blocks.append(make_block(kernel, group, states))
    for index, state in states.items():
        unknown = [str(s) for s in state if str(s) not in names and str(s) not in used]
        if unknown:
            raise UnknownNameError(
                f"Look {index} has a value for '{unknown[0]}', which the model does not have. "
                f"{suggest(unknown[0], names, 'symbol')}"
            )
    for unknown_parameter in prepared.unknowns:
        symbol = unknown_parameter.inner
        everywhere = {s for block in blocks for s in block.parameters} | set(model.symbols)
        if not unknown_parameter.unit and symbol not in everywhere:
            raise UnknownNameError(
                f"Parameter '{symbol}' with the value {symbol.value:g} is neither in the model nor in an "
                "observation."
            )
    return blocks


def _stated_noise(
    noise: tuple[float, float] | Mapping[str, float] | None, blocks: Sequence[ResidualBlock]
) -> dict[str, float]:
    """Return the sizes of the noise that are given, by group."""
    if noise is None:
        return {}
    if isinstance(noise, Mapping):
        given = dict(noise)
    else:
        try:
            position, orientation = noise
        except (TypeError, ValueError):
            raise InvalidValueError(
                f"noise= is a pair of standard deviations, position [m] and orientation [rad], not {noise!r}."
            ) from None
        given = {"position": position, "orientation": orientation}
    groups = {group.name for block in blocks for group in block.groups} | {"position", "orientation"}
    for name, size in given.items():
        if name not in groups:
            raise UnknownNameError(f"There is no noise of '{name}'. {suggest(str(name), groups, 'group')}")
        given[name] = as_positive(size, f"The noise of '{name}'")
    return given


def _check_count(problem: CalibrationProblem, unknowns: int) -> None:
    """Refuse fewer numbers than unknowns."""
    numbers = sum(block.looks.size * _size(block) for block in problem.blocks)
    looks = len({look for block in problem.blocks for look in block.looks.tolist()})
    needed = unknowns + (1 if problem.unknown else 0)
    if numbers < needed:
        noise = " and the noise" if problem.unknown else ""
        raise InvalidValueError(
            f"Too few looks: {unknowns} free parameters{noise} need at least {needed} observed numbers, and "
            f"{looks} {'look has' if looks == 1 else 'looks have'} {numbers}. Record more, or free less."
        )


def _size(block: ResidualBlock) -> int:
    """Return the number of rows of one residual of a block."""
    return max(int(group.rows.stop) for group in block.groups)


def _starts(
    problem: CalibrationProblem, prepared: _Prepared, place: Mapping[Symbol, int], present: Array
) -> list[Array]:
    """Return the present values, and those with mounts in closed form."""
    mounts = [[place[s] for s in c.symbols] for c in prepared.corrections if c.word == "mount"]
    poses = [
        (block, columns.tolist())
        for block, columns in zip(problem.blocks, problem.columns, strict=True)
        if isinstance(block, CompiledBlock) and block.kind == "pose"
    ]
    return [present, start_mounts(poses, mounts, present)] if mounts and poses else [present]


def _result(
    model: Model,
    prepared: _Prepared,
    problem: CalibrationProblem,
    fit: CalibrationFit,
    before: list[Linearised],
    folds: int,
) -> Calibration:
    unknowns, scales = prepared.unknowns, problem.scales
    # What no observation depends on is exactly as it was.
    present = np.array([u.outer.value or 0.0 for u in unknowns])
    values = np.where(np.diag(fit.hessian) > 0.0, fit.values * scales, present)
    names = [str(u.outer) for u in unknowns]
    covariance = pseudo_inverse(fit.hessian)[0] * np.outer(scales, scales)
    directions, deviations = _directions(problem, fit)
    state = State({u.outer: float(v) for u, v in zip(unknowns, values, strict=True)}, source="calibration")
    tags = set(_by_tag(prepared.corrections))
    new = {u.inner: parameter(u.inner.path, math.pi) for u in unknowns if not u.unit}
    if new:
        ours = {tag: model.history.operation(tag) for tag in model.history.tags}
        tags |= {tag for tag, one in ours.items() if with_parameters(one, new) is not one}
    outliers = tuple(
        Outlier(int(block.looks[k]), block.label, float(weights[k]))
        for block, weights in zip(problem.blocks, fit.weights, strict=True)
        for k in np.flatnonzero(weights < 0.5)
    )
    inliers: list[Mask] = [w >= 0.5 for w in fit.weights]
    looks = np.unique(np.concatenate([block.looks for block in problem.blocks]))
    return Calibration(
        state,
        covariance,
        dict(zip(names, (deviations * scales).tolist(), strict=True)),
        tuple({names[i]: float(d[i]) for i in np.flatnonzero(np.abs(d) > 0.01)} for d in directions),
        fit.noise,
        outliers,
        _rms(problem, before, inliers),
        _held_out(problem, fit, inliers, looks, folds),
        len(looks),
        {str(u.outer): u.unit for u in unknowns},
        {tag: model.history.operation(tag) for tag in model.history.tags if tag in tags},
        model,
        tuple(prepared.corrections),
    )


def _directions(problem: CalibrationProblem, fit: CalibrationFit) -> tuple[list[Array], Array]:
    """Return the directions that the data do not tell, and the standard deviations of all parameters."""
    count = len(problem.scales)
    values, axes = np.linalg.eigh(fit.hessian)
    untold, told = np.split(axes, [count - fit.rank], axis=1)
    # An untold direction is as uncertain as its prior size. What it adds may be small beside the rest.
    further = np.square(untold).sum(axis=1)
    own = (np.square(told) / values[count - fit.rank :]).sum(axis=1)
    return _simple_basis(untold.T), np.where(further > own, math.inf, np.sqrt(own + further))


def _simple_basis(rows: Array) -> list[Array]:
    """Return directions of a space, each without the largest component of each of the others."""
    rows = rows.copy()
    for k in range(len(rows)):
        i, j = np.unravel_index(np.argmax(np.abs(rows[k:])), rows[k:].shape)
        rows[[k, k + int(i)]] = rows[[k + int(i), k]]
        rows[k] = rows[k] / rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, j], rows[k])
    return [np.asarray(row / np.linalg.norm(row)) for row in rows]


def _rms(problem: CalibrationProblem, linear: Sequence[Linearised], used: Sequence[Mask]) -> dict[str, float]:
    """Return the root mean square of the length of the residuals by group, of some observations."""
    sums = _sums(problem, linear, used)
    return {name: math.sqrt(total / count) for name, (total, count) in sums.items() if count}


def _sums(
    problem: CalibrationProblem, linear: Sequence[Linearised], used: Sequence[Mask]
) -> dict[str, list[float]]:
    """Return the sums of squared lengths of residuals, and their numbers, by group."""
    sums: dict[str, list[float]] = {}
    for i, (block, one) in enumerate(zip(problem.blocks, linear, strict=True)):
        residual, whiten = one.residual, problem.whiten[i]
        if whiten is not None:
            residual = np.asarray(np.linalg.solve(whiten, residual[..., None])[..., 0])
        for group in block.groups:
            squares = np.square(residual[used[i]][:, group.rows]).sum(axis=1)
            total = sums.setdefault(group.name, [0.0, 0.0])
            total[0] += float(squares.sum())
            total[1] += len(squares)
    return sums


def _held_out(
    problem: CalibrationProblem, fit: CalibrationFit, inliers: Sequence[Mask], looks: Array, folds: int
) -> dict[str, float]:
    """Return the error of looks that are left out, each in one of several parts."""
    if not folds or len(looks) < 2:
        return {}
    totals: dict[str, list[float]] = {}
    for fold in range(min(folds, len(looks))):
        out = [np.isin(block.looks, looks[fold::folds]) for block in problem.blocks]
        values = problem.refit(fit, [np.where(o, 0.0, 1.0) for o in out])
        used = [o & i for o, i in zip(out, inliers, strict=True)]
        for name, (total, count) in _sums(problem, problem.linearise(values), used).items():
            known = totals.setdefault(name, [0.0, 0.0])
            known[0] += total
            known[1] += count
    return {name: math.sqrt(total / count) for name, (total, count) in totals.items() if count}
