"""However code looks at what it reads: a change is followed as the code would, or refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from trace_models import KNOB, LIFT, WHEEL, agree, build, changed, read_document, reloaded

import kineverse as kv
from kineverse.expressions.gradient import total_derivative
from kineverse.formats.document import OpaqueOperation, to_json
from kineverse.model.basic_operations import SetRate
from kineverse.model.rates import as_row

Code = Callable[[kv.model.ReadRecorder], kv.model.Writes]

CHANGES: dict[str, dict[str, Any]] = {
    "at rest": {"car": kv.translation(0.5, 0, 1)},
    "identity": {"car": np.eye(4)},
    "turning only": {"car": kv.rotation_z(LIFT)},
    "plain": {"car": kv.translation(0.1, 0, LIFT) @ kv.rotation_x(LIFT)},
    "curved": {"car": kv.translation(0.1, 0, LIFT**2) @ kv.rotation_x(LIFT)},
    "augmented": {"car": kv.translation(0, 0, LIFT.augment({WHEEL: 3})) @ kv.rotation_x(LIFT)},
    "in factors": {"car": [kv.translation(0, 0, LIFT), kv.rotation_x(LIFT), kv.rotation_z(0.3)]},
    "upper number": {"upper": 4.5},
    "upper symbol": {"upper": KNOB},
    "upper parameter": {"upper": kv.parameter("height", 2.5)},
    "zero": {"number": 0.0},
    "number": {"number": 2.25},
    "whole": {"number": 3},
    "negative": {"number": -1.0},
    "symbol": {"number": KNOB},
    "damping": {"damping": 0.7},
}


SOME = ("at rest", "curved", "augmented", "upper symbol", "zero", "negative", "symbol")
"""Changes of each kind, of which some are followed and others are not, whatever decides."""

of_changes = pytest.mark.parametrize(
    "changes", [pytest.param(SOME, id="some"), pytest.param(tuple(CHANGES), id="all", marks=pytest.mark.long)]
)


def said(value: Callable[[kv.model.ReadRecorder], Any]) -> Code:
    return lambda model: kv.model.Writes(data={"said": value(model)})


def placed(value: Callable[[kv.model.ReadRecorder], Any]) -> Code:
    return lambda model: kv.model.Writes(frames={"knob": ("car", value(model))})


def limited(value: Callable[[kv.model.ReadRecorder], Any]) -> Code:
    return lambda model: kv.model.Writes(constraints={"near": value(model)})


def upper(model: kv.model.ReadRecorder) -> kv.Expression:
    """Read the one limit."""
    return model.constraints["range"].upper


def is_pose(model: kv.model.ReadRecorder) -> bool:
    """Decide by whether something raises."""
    try:
        kv.model.Pose.from_matrix(model.fk("car"))
    except kv.KineverseError:
        return False
    return True


DECIDING: dict[str, Code] = {
    "compares a pose": said(lambda m: m.fk("car") == kv.array(np.eye(4))),
    "compares a limit": said(lambda m: upper(m) == 4.5),
    "compares a number": said(lambda m: m.data["number"] == 0),
    "compares with a symbol": said(lambda m: m.data["number"] == KNOB),
    "looks in a tuple": said(lambda m: m.data["number"] in (0.0, 3.0)),
    "looks in a set": said(lambda m: upper(m) in {KNOB, LIFT}),
    "looks in a mapping": said(lambda m: {KNOB: 7}.get(upper(m), 8)),  # type: ignore[call-overload]
    "array_equal": said(lambda m: bool(np.array_equal(m.fk("car"), np.eye(4)))),  # type: ignore[arg-type]
    "type of a limit": said(lambda m: isinstance(upper(m), kv.Symbol)),
    "type of an element": said(lambda m: isinstance(m.fk("car")[2, 3], kv.Symbol)),
    "type of a number": said(lambda m: type(m.data["number"]) is float),
    "identity": lambda m: kv.model.Writes(
        data={"said": upper(m) is KNOB}, frames={"knob": ("car", kv.translation(KNOB, 0, 0))}
    ),
    "is_constant": said(lambda m: m.fk("car").is_constant),
    "is_constant of a limit": said(lambda m: upper(m).is_constant),
    "whether it is a pose": said(is_pose),
    "prints a pose": said(lambda m: "cos" in repr(m.fk("car"))),
    "prints a limit": said(lambda m: "height" in str(upper(m))),
    "digest": said(lambda m: upper(m).key == kv.array(4.5).key),
    "LaTeX": said(lambda m: "height" in upper(m)._repr_latex_()),
    "symbols of an element": said(lambda m: len(m.fk("car")[2, 3].symbols)),
    "symbols of a gradient": said(
        lambda m: sum(len(e.symbols) for e in m.fk("car")[2, 3].gradient().values())
    ),
    "keys of a gradient": said(lambda m: tuple(map(str, m.fk("car")[1, 3].gradient()))),
    "factors": placed(lambda m: m.frames["car"].factors[0]),
    "number of factors": said(lambda m: len(m.frames["car"].factors)),
    "casadi": said(lambda m: m.fk("car").casadi.nnz()),
    "a value": said(lambda m: float(m.fk("car")({"lift": 0.3})[2, 3])),
    "compiled": said(lambda m: float(kv.compile([m.fk("car")])({"lift": 0.3})[0][2, 3])),
    "sine": said(lambda m: math.sin(m.data["number"])),
    "if": said(lambda m: 2.0 if m.data["number"] > 1 else 3.0),
    "format": lambda m: kv.model.Writes(data={f"about {m.data['number']:.0f}": upper(m)}),
    "least": said(lambda m: min(m.data["number"], 2.0)),
    "range of what does not move": limited(lambda m: (0, m.fk("car")[2, 3], 1)),
    "range of nothing": limited(lambda m: (0, KNOB, m.data["number"])),
    "axis": placed(lambda m: kv.axis_angle((m.data["number"], 0, 0), KNOB)),
    "one by zero": said(lambda m: 1 / m.data["number"]),
    "not a number": placed(lambda m: kv.translation(np.sqrt(m.data["number"]), 0, 0)),
}
FOLLOWED: dict[str, Code] = {
    "a limit": limited(lambda m: (0, KNOB, upper(m))),
    "a limit of data": limited(lambda m: (-5, KNOB, m.data["number"])),
    "Constraint.from_expressions": limited(
        lambda m: kv.Constraint.from_expressions(-9, 2 * KNOB, upper(m) + 9)
    ),
    "a constraint": limited(lambda m: m.constraints["range"]),
    "a frame": lambda m: kv.model.Writes(frames={"knob": m.frames["car"]}),
    "a frame elsewhere": lambda m: kv.model.Writes(frames={"knob": replace(m.frames["car"], parent="flap")}),
    "a record": lambda m: kv.model.Writes(
        articulations={"other": replace(m.articulations["hinge"], child="other")}
    ),
    "damping": said(lambda m: 2 * dict(m.articulations["hinge"].dynamics)["damping"]),
    "axis": placed(lambda m: kv.axis_angle((m.data["number"], 0.5, 1), KNOB)),
    "quaternion": placed(lambda m: kv.quaternion(m.data["number"], 0.5, 0, 1)),
    "normalised": placed(lambda m: kv.translation(*(v := kv.array([m.data["number"], 3, 1])) / kv.norm(v))),
    "Jacobian": limited(lambda m: (0, KNOB + m.fk("car")[:3, 3].jacobian([LIFT])[2, 0], 1)),
    "facts": limited(lambda m: (0, KNOB + m.fk("car")[2, 3].jacobian([LIFT, KNOB], heuristic=False)[0], 1)),
    "partial": limited(lambda m: (0, KNOB + m.fk("car")[:3, 3].partial([LIFT])[2, 0], 1)),
    "substitution": placed(lambda m: m.fk("car").substitute({LIFT: KNOB * m.data["number"]})),
    "spline": limited(lambda m: (0, KNOB + kv.spline(m.fk("car")[2, 3], (0, 1, 2), (0, 1, 0)), 1)),
    "a table": limited(
        lambda m: (
            -1,
            KNOB,
            kv.articulations.tabulated_limit(m.constraints["range"].expression, {0: 1, 3: 2}),
        )
    ),
    "a joint": lambda m: kv.Revolute(
        name="knob", parent="car", child="knob", axis=(0, 0, 1), lower=-9, upper=upper(m)
    ).apply(m),
    "least": said(lambda m: kv.minimum(m.data["number"], 2.0)),
    "clip": said(lambda m: np.clip(m.data["number"], 0, 2.0)),
}


@cache
def upstream(name: str) -> kv.Model:
    """Return a model with a change, and an operation that reads nothing."""
    return build(lambda m: kv.model.Writes(), **CHANGES[name])


def outcome(code: Code, document: str, name: str) -> bool:
    """Return whether a stranger follows a change; if so, as the code does."""
    change, read = CHANGES[name], read_document(document)
    before = read.snapshot()
    try:
        live = build(code, **change)
    except (kv.KineverseError, ValueError):
        live = None
    try:
        changed(read, upstream(name))
    except kv.errors.EditError:
        assert read.snapshot() == before
        return False
    assert live is not None, "the code refuses this change"
    agree(read, live)
    for name in {*read.data, *live.data}:
        a, b = read.data[name], live.data[name]
        assert a == b or kv.array(a - b)({"knob": 0.3}) == pytest.approx(0, abs=1e-14)
    assert dict(read.articulations) == dict(live.articulations)
    return True


@of_changes
@pytest.mark.parametrize("code", DECIDING.values(), ids=DECIDING)
@pytest.mark.sampled(3)
def test_accesses_that_decide_are_recorded(code: Code, changes: tuple[str, ...]) -> None:
    document = to_json(build(code))
    outcomes = [outcome(code, document, name) for name in changes]
    assert not all(outcomes)
    assert any(outcomes)


@pytest.mark.sampled(2)
@of_changes
@pytest.mark.parametrize("code", FOLLOWED.values(), ids=FOLLOWED)
def test_common_code_is_followed_everywhere(code: Code, changes: tuple[str, ...]) -> None:
    document = to_json(build(code))
    for name in changes:
        assert outcome(code, document, name) or name in ("negative", "symbol"), name


def test_code_that_needs_its_numbers_follows_poses() -> None:
    read = reloaded(build(DECIDING["if"]))
    both = reloaded(
        build(
            lambda m: kv.model.Writes(
                frames={"knob": ("car", kv.translation(round(m.data["number"], 1), m.fk("car")[2, 3], 0))}
            )
        )
    )
    assert _recorded(read).frozen
    assert not _recorded(both).frozen


def _recorded(model: kv.Model) -> OpaqueOperation:
    operation = model.history.operation("custom")
    assert isinstance(operation, OpaqueOperation)
    return operation


def asking(ask: Callable[[kv.model.ReadRecorder], Any]) -> Code:
    """Return code that does without what is not there."""

    def code(model: kv.model.ReadRecorder) -> kv.model.Writes:
        try:
            ask(model)
            there = True
        except kv.KineverseError:
            there = False
        return kv.model.Writes(data={"there": there, "twice": 2 * model.data["number"]})

    return code


@pytest.mark.parametrize(
    "ask",
    [
        lambda m: m.fk("new"),
        lambda m: m.fk("car", "new"),
        lambda m: m.coordinates_between("new"),
        lambda m: m.frames["new"],
        lambda m: m.data.get("", 1) and m.frames["new"],
    ],
)
def test_a_name_that_was_missing_must_stay_missing(ask: Callable[[kv.model.ReadRecorder], Any]) -> None:
    read = reloaded(build(asking(ask)))
    changed(read, build(asking(ask), number=4.0))
    assert read.data["twice"] == 8.0
    with (
        pytest.raises(kv.errors.EditError, match=r"made from it: the names and kinds of \w+\("),
        read.edit() as edit,
    ):
        edit.insert(
            kv.model.AddFrame("new", kv.model.Frame.from_transform("world", np.eye(4))), before="custom"
        )


@pytest.mark.parametrize(
    ("value", "follows"),
    [
        (lambda m: m.carry(LIFT) * m.resolve(LIFT), True),
        (lambda m: len(m.carry(LIFT).gradient()), False),
        (lambda m: m.carry(LIFT) is LIFT, False),
        (lambda m: "lift" in m.by_kind("rates"), False),
        (lambda m: total_derivative(m.fk("car")[2, 3]), False),
    ],
)
def test_rates_upstream(value: Callable[[kv.model.ReadRecorder], Any], follows: bool) -> None:
    rolling = SetRate(LIFT, as_row(LIFT, {WHEEL: 2 * KNOB}))
    read, live = reloaded(build(said(value))), build(said(value))
    with live.edit() as edit:
        edit.insert(rolling, before="custom")
    try:
        with read.edit() as edit:
            edit.insert(rolling, before="custom")
    except kv.errors.EditError:
        assert not follows
    else:
        assert follows
        assert read.data["said"] == live.data["said"]


def test_between_frames_of_one_carriage_only_they_matter() -> None:
    code: Code = lambda m: kv.model.Writes(frames={"knob": ("world", m.fk("flap", "car"))})  # noqa: E731
    read = reloaded(build(code))
    runs = read._history.runs
    changed(read, live := build(code, car=kv.rotation_z(LIFT)))
    agree(read, live)
    assert _recorded(read).trace is not None
    assert read._history.runs > runs
