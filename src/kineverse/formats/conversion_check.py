"""Comparison of a file with a model: poses of all frames, by an engine that reads the format on its own."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from msgspec import Struct

from kineverse._checks import as_count
from kineverse.errors import FormatError, InvalidValueError, list_some
from kineverse.lie import rotation_angle
from kineverse.model import registry
from kineverse.model.model_view import ModelView
from kineverse.model.registry import FrameDeviation
from kineverse.model.sampling import StateSamples

from .engines import PoseEngine
from .export.link_tree import sort_parents_first

STATES = 100


class ConversionCheck(Struct, frozen=True):
    """Difference between the poses of a model and those of a file in an engine.

    ``largest`` are the largest distance [m] and angle [rad] of any frame in any state, ``frame`` is the frame
    of the larger one, and ``joint`` the joint that moves it. ``wrong`` are the differences above what is
    allowed, by frame, or by the joint of a loop; ``cause`` is the first joint from the root at which they
    appear. ``bounds`` are the guaranteed bounds of approximated frames.

    See Also
    --------
    kineverse.formats.check_conversion
    """

    engine: str
    version: str
    states: int
    frames: int
    largest: FrameDeviation
    frame: str
    joint: str
    wrong: Mapping[str, FrameDeviation]
    cause: str
    bounds: FrameDeviation
    remarks: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """True if no frame differs by more than is allowed."""
        return not self.wrong


def find_engine(path: str | os.PathLike[str]) -> type[PoseEngine]:
    """Return the engine that reads files of a name; raise if there is none, or if it is not installed."""
    name = Path(path).name
    target = registry.find_writer(name)
    if target is None or not target.engine:
        with_engine = sorted({end for one in registry.list_formats() if one.engine for end in one.written})
        raise InvalidValueError(
            f"{name} cannot be checked: no other engine reads it, only {', '.join(with_engine)}."
        )
    engine: type[PoseEngine] = registry.import_entry(target.engine)  # type: ignore[assignment]
    engine.require()
    return engine


def check_conversion(
    model: ModelView,
    path: str | os.PathLike[str],
    *,
    states: int = STATES,
    bounds: Mapping[str, FrameDeviation] | None = None,
) -> ConversionCheck:
    """Compare the poses of all frames of a model with those of a file written from it, in another engine.

    The engine is pinocchio for URDF, MuJoCo for MJCF and drake for SDF. It reads the file with its own
    parser, and gets the values of all coordinates in each state, of dependent ones as well. OpenUSD reads
    USD, and the kinematics are those of Kineverse.

    Parameters
    ----------
    states
        Number of states: the default state, and random ones within limits, the same in every call.
    bounds
        Allowed differences of approximated frames [m], [rad], as in ``errors`` of the result of a save; other
        frames may differ by 1e-9, in USD by 1e-6, as its joints are in single precision.

    Raises
    ------
    InvalidValueError
        If no other engine reads the format, or for a number of states below 1.
    MissingDependencyError
        If the engine is not installed, with the command that installs it.
    FormatError
        If the engine does not read the file, if it lacks a frame, or if it has a joint that the model lacks.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> result = model.save("kitchen.urdf")
    >>> check = kv.formats.check_conversion(model, "kitchen.urdf", states=5)
    >>> check.engine, check.ok
    ('pinocchio', True)
    """
    states = as_count("states", states, 1)
    engine = find_engine(path)(Path(path))
    columns = {name: k for k, name in enumerate(engine.frames)}
    names = [name for name in sort_parents_first(model) if name in columns]
    missing = [name for name in model.frames if name not in columns and name not in engine.skipped]
    if missing:
        raise FormatError(f"{Path(path).name} lacks frames of the model: {list_some(map(repr, missing), 6)}.")
    values, poses = _sample(model, names, states)
    distance, angle = np.zeros(len(names)), np.zeros(len(names))
    chosen = [columns[name] for name in names]
    for state, expected in zip(values, poses, strict=True):
        try:
            found = engine.poses(state)[chosen]
        except KeyError as error:
            raise FormatError(
                f"{Path(path).name} has a joint with the coordinate {error}, which the model lacks."
            ) from None
        distance = np.maximum(distance, np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1))
        turned = np.swapaxes(found[:, :3, :3], 1, 2) @ expected[:, :3, :3]
        angle = np.maximum(angle, rotation_angle(turned))
    errors = {
        name: FrameDeviation(float(p), float(a)) for name, p, a in zip(names, distance, angle, strict=True)
    }
    allowed = dict(bounds or {})
    rounding = engine.equal
    wrong = {name: error for name, error in errors.items() if _exceeds(error, allowed.get(name), rounding)}
    gaps = {name: gap for name, gap in engine.closures().items() if _exceeds(gap, None, rounding)}
    joints = {record.child: name for name, record in model.articulations.items()}
    worst = max(errors, key=lambda name: max(errors[name].position, errors[name].angle), default="")
    first = next(iter(wrong), "")
    return ConversionCheck(
        engine.name,
        engine.version(),
        len(values),
        len(names),
        FrameDeviation(float(distance.max(initial=0.0)), float(angle.max(initial=0.0))),
        worst,
        joints.get(worst, ""),
        {**wrong, **gaps},
        joints.get(first, first) or next(iter(gaps), ""),
        _largest(allowed),
        tuple(engine.remarks),
    )


def _exceeds(error: FrameDeviation, bound: FrameDeviation | None, rounding: float) -> bool:
    """Return whether an error is above its bound and rounding; one that is no number is."""
    position, angle = (0.0, 0.0) if bound is None else (bound.position, bound.angle)
    position, angle = position + rounding, angle + rounding
    return not (error.position <= position and error.angle <= angle)


def _largest(bounds: Mapping[str, FrameDeviation]) -> FrameDeviation:
    return FrameDeviation(
        max((bound.position for bound in bounds.values()), default=0.0),
        max((bound.angle for bound in bounds.values()), default=0.0),
    )


def _sample(
    model: ModelView, names: list[str], states: int
) -> tuple[list[dict[str, float]], list[np.ndarray]]:
    """Return the values of all coordinates in each state by path, and the poses of frames, (n, 4, 4).

    States in which a loop does not close are left out.
    """
    samples = StateSamples(model, count=states - 1)
    dependent = model.rates.dependent
    expressions = [*dependent.values(), *(model.rates.resolve(model.fk(name)) for name in names)]
    numbers = samples.values(expressions)
    free = {s.path: samples.values_of(s) for s in model.degrees_of_freedom}
    followers = {s.path: x for s, x in zip(dependent, numbers, strict=False)}
    poses = np.array(numbers[len(followers) :]).reshape(len(names), samples.size, 4, 4)
    values, kept = [], []
    for k in range(samples.size):
        state = {path: float(column[k]) for path, column in {**free, **followers}.items()}
        if np.isfinite(poses[:, k]).all() and np.isfinite(list(state.values())).all():
            values.append(state)
            kept.append(poses[:, k])
    if not values:
        raise FormatError(
            "In none of the states do the loops of the model close: there is nothing to compare."
        )
    return values, kept
