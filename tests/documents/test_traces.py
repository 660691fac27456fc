"""Operations of documents follow changes upstream without their code, or refuse them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trace_models import KNOB, LIFT, WHEEL, Custom, agree, build, build_scene, changed, reloaded

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.document import OpaqueOperation, read_operations, to_json


def follower(model: kv.model.ReadRecorder) -> kv.model.Writes:
    """Read one of everything, compute with it, augment it and differentiate it."""
    pose, place = model.fk("car"), model.frames["car"].transform
    upper, slope = model.constraints["range"].upper, pose[:3, 3].jacobian([LIFT])[2, 0]
    rolling = (KNOB * pose[0, 3]).augment({WHEEL: pose[2, 3]})
    flap = model.articulations["hinge"].position
    assert flap is not None
    open_ = (flap < 0.5) & (upper > LIFT)
    return kv.model.Writes(
        frames={"knob": ("car", kv.translation(rolling, slope, 0) @ place)},
        constraints={"near": (-open_, KNOB + slope * LIFT, 2 * upper)},
        data={"twice": 2 * model.data["number"]},
    )


CHANGES: tuple[dict[str, Any], ...] = (
    {"car": kv.translation(0.3, 0, 5 * LIFT) @ kv.rotation_z(LIFT)},
    {"car": kv.translation(0, 0, LIFT**2)},
    {"upper": 4.5},
    {"upper": kv.parameter("height", 2.5)},
    {"number": 2.25},
    {"damping": 0.7},
    {"upper": 1.0, "number": 0.0, "car": kv.rotation_y(LIFT)},
)


@pytest.mark.parametrize("change", CHANGES)
def test_a_trace_follows_upstream_changes(change: dict[str, Any]) -> None:
    read, live = reloaded(build(follower)), build(follower, **change)
    changed(read, live)
    agree(read, live)
    assert read.data["twice"] == live.data["twice"]
    assert type(read.data["twice"]) is float


def test_a_followed_change_is_saved_and_followed_again() -> None:
    read = reloaded(build(follower))
    changed(read, build(follower, upper=4.5))
    again = reloaded(read)
    assert to_json(again) == to_json(read)
    live = build(follower, number=7.0, car=kv.translation(0, 0, LIFT))
    changed(again, live)
    agree(again, live)


def test_a_change_and_back_is_the_first_to_the_last_bit() -> None:
    model = build(follower)
    read = reloaded(model)
    changed(read, build(follower, **CHANGES[0]))
    assert read.snapshot() != model.snapshot()
    changed(read, model)
    assert read.snapshot() == model.snapshot()
    assert to_json(read) == to_json(model)


@st.composite
def programs(draw: st.DrawFn) -> Callable[[kv.model.ReadRecorder], kv.model.Writes]:
    """Return code that makes something at random of what it reads."""
    steps = draw(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 99), st.integers(0, 99)), max_size=8))

    def code(model: kv.model.ReadRecorder) -> kv.model.Writes:
        pose = model.fk("car")
        values: list[Any] = [
            KNOB,
            pose[2, 3],
            model.frames["car"].transform[1, 1],
            model.constraints["range"].upper,
            model.data["number"],
        ]
        for kind, i, j in steps:
            a, b = values[i % len(values)], values[j % len(values)]
            a, b = a + 0 * KNOB, b + 0 * LIFT
            values.append(
                (
                    lambda a, b: a + b,
                    lambda a, b: a * b,
                    lambda a, b: np.sin(a) - b,
                    lambda a, b: a.augment({WHEEL: b}),
                    lambda a, b: kv.where(a < b, a, b),
                    lambda a, b: a.jacobian([LIFT])[0] + b,
                    lambda a, b: b.with_gradient({WHEEL: a}),
                    lambda a, b: a.gradient().get(WHEEL, kv.array(0.0)) + b,
                    lambda a, b: kv.maximum(a, b),
                    lambda a, b: a.substitute({LIFT: b}),
                )[kind](a, b)
            )
        last = values[-1] + KNOB
        return kv.model.Writes(
            frames={"knob": ("car", kv.translation(last, 0, 0))},
            constraints={"near": (-1, last + LIFT, values[-1] * values[-1])},
        )

    return code


@given(programs(), st.sampled_from(CHANGES))
@settings(max_examples=attempts(15), deadline=None)
def test_any_code_is_followed_rightly_or_the_change_refused(code: Any, change: dict[str, Any]) -> None:
    read = reloaded(build(code))
    before, live = read.snapshot(), build(code, **change)
    try:
        changed(read, live)
    except kv.errors.EditError:
        assert read.snapshot() == before
    else:
        agree(read, live)


def test_most_code_needs_no_value() -> None:
    (operation,) = (o for t, o in read_operations(to_json(build(follower))) if t == "custom")
    assert isinstance(operation, OpaqueOperation)
    assert not operation.frozen
    assert operation.trace is not None


def branching(model: kv.model.ReadRecorder) -> kv.model.Writes:
    """Decide by a number."""
    far = float(model.data["number"]) > 1
    return kv.model.Writes(
        frames={"knob": ("car", kv.translation(KNOB if far else 0, model.fk("car")[2, 3], 0))}
    )


def listing(model: kv.model.ReadRecorder) -> kv.model.Writes:
    """Decide by what there is."""
    return kv.model.Writes(data={"count": len(list(model.frames)), "at": model.data["number"]})


def gambling(model: kv.model.ReadRecorder) -> kv.model.Writes:
    """Decide by the text of an expression, which nobody notices."""
    return kv.model.Writes(data={"length": len(repr(model.fk("car")))})


@pytest.mark.parametrize(("code", "change"), [(branching, {"number": 0.5}), (gambling, CHANGES[0])])
def test_a_value_that_the_operation_depends_on_must_stay(code: Any, change: dict[str, Any]) -> None:
    read = reloaded(build(code))
    before = read.snapshot()
    with pytest.raises(
        kv.errors.EditError, match=r"'custom': .* has changed, and this Custom was made from it"
    ):
        changed(read, build(code, **change))
    assert read.snapshot() == before


def test_a_value_that_the_operation_does_not_depend_on_may_change() -> None:
    read = reloaded(build(branching))
    live = build(branching, car=kv.translation(0, 0, 7 * LIFT))
    changed(read, live)
    agree(read, live)


def test_names_that_it_listed_must_stay() -> None:
    read = reloaded(build(listing))
    changed(read, build(listing, number=3.0))
    assert (read.data["count"], read.data["at"]) == (2, 3.0)
    with pytest.raises(kv.errors.EditError, match="list of all frames"), read.edit() as edit:
        edit.insert(
            kv.model.AddFrame("new", kv.model.Frame.from_transform("world", kv.translation(1, 0, 0))),
            before="custom",
        )


def test_a_frozen_one_is_replaced_in_the_same_edit() -> None:
    read, live = reloaded(build(branching)), build(branching, number=0.5)
    with read.edit() as edit:
        edit.replace("data number", kv.model.SetData("number", 0.5))
        edit.replace("custom", Custom(branching))
    assert read.snapshot() == live.snapshot()


def test_a_loop_from_a_document_is_made_anew_from_its_parameters() -> None:
    model = build_scene("four_bar")
    read = reloaded(model)
    (tag,) = (t for t in read.history.tags if t.startswith("loop"))
    loop = read.history.operation(tag)
    assert isinstance(loop, OpaqueOperation)
    assert loop.frozen
    assert kv.CloseLoop(**loop.parameters) == model.history.operation(tag)


STRANGER = """
import sys
import kineverse as kv
read = kv.load(sys.argv[1])
assert not any(c.__name__ == "Custom" for c in kv.Operation.__subclasses__())
with read.edit() as edit:
    car = kv.translation(0.3, 0, 5 * kv.position("lift")) @ kv.rotation_z(kv.position("lift"))
    edit.replace("frame car", kv.model.AddFrame("car", kv.model.Frame.from_transform("world", car)))
read.save(sys.argv[2])
"""


def test_another_process(tmp_path: Path) -> None:
    """What is saved there, after the edit there, says what the code says here."""
    path, back = tmp_path / "model.kv.json", tmp_path / "back.kv.json"
    build(follower).save(path)
    subprocess.run([sys.executable, "-c", STRANGER, path, back], check=True, timeout=60)
    agree(kv.load(back), build(follower, **CHANGES[0]))
