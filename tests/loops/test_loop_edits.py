"""Models with closed loops are edited, copied, saved and heard of like any other."""

import copy
import pickle

import numpy as np
import pytest
from linkages import GALLERY, four_bar, four_bar_by_circles, limited_four_bar
from loop_checks import assert_closed, dependent, function, record

import kineverse as kv

crank, coupler, rocker = (kv.position(n) for n in ("crank", "coupler", "rocker"))


@pytest.fixture(scope="module")
def bars():
    return four_bar(home={"rocker": 1.5})


@pytest.fixture
def model(bars):
    return bars.copy()


@pytest.fixture(scope="module")
def limited_bars():
    return limited_four_bar()


@pytest.fixture
def limited(limited_bars):
    return limited_bars.copy()


def meeting(model, angle=0.7):
    return model.fk("rocker_tip")({"crank": angle})[:2, 3]


# -- edits -------------------------------------------------------------------------------------------------


def test_a_bar_of_another_length_closes_again(model):
    np.testing.assert_allclose(meeting(model), four_bar_by_circles(0.7), rtol=0, atol=1e-11)
    with model.edit() as edit:
        edit.replace("frame coupler_tip", _frame("coupler_tip", "coupler", 1.2))
    np.testing.assert_allclose(meeting(model), four_bar_by_circles(0.7, b=1.2), rtol=0, atol=1e-11)
    assert_closed(model, 100)
    assert model.symbols == (crank,)


def _frame(name, parent, length):
    probe = kv.Model()
    with probe.edit() as edit:
        edit.add_frame(parent, "world", kv.translation(0, 0, 0))
        edit.add_frame(name, parent, kv.translation(length, 0, 0))
    return probe.history.entry(f"frame {name}").operation


def test_an_edit_that_opens_it_is_refused_and_nothing_happened(model):
    before, version, was = model.snapshot(), model.version, meeting(model).tobytes()
    for length in (0.2, 9.0):
        with (
            pytest.raises(kv.KineverseError, match=r"'four-bar' does not close") as caught,
            model.edit() as edit,
        ):
            edit.add_frame("other", "world", kv.translation(1, 0, 0))
            edit.replace("frame coupler_tip", _frame("coupler_tip", "coupler", length))
        assert "loop four-bar" in str(caught.value)
        assert (model.snapshot(), model.version, meeting(model).tobytes()) == (before, version, was)
    with pytest.raises(kv.KineverseError, match="loop four-bar"), model.edit() as edit:
        edit.remove("frame rocker_tip")
    assert model.snapshot() == before


def test_without_the_loop_coordinates_are_free_again(model):
    with model.edit() as edit:
        edit.remove("loop four-bar")
    assert set(model.symbols) == {crank, coupler, rocker}
    assert model.rates.is_empty
    assert "four-bar" not in model.articulations
    assert model.snapshot() == four_bar(close=False).snapshot()
    assert set(model.fk("rocker_tip").symbols) == {rocker}
    with model.edit() as edit:
        edit.close_loop("coupler_tip", "rocker_tip", name="four-bar", home={"rocker": -1.5})
    np.testing.assert_allclose(meeting(model), four_bar_by_circles(0.7, side=-1), rtol=0, atol=1e-11)


def test_constraints_know_of_it_when_it_comes_and_goes(limited):
    model = limited
    assert "rocker/position" in model.constraints_for([crank])
    assert "rocker/position" in [v.name for v in model.violations({"crank": 3.0})]
    with model.edit() as edit:
        edit.remove("loop four-bar")
    assert "rocker/position" not in model.constraints_for([crank])
    assert not model.constraints_for([crank]).keys() - {"coupler/beside"}
    assert not list(model.violations({"crank": 3.0, "rocker": 1.5, "coupler": 4.0}))
    with model.edit() as edit:
        edit.close_loop("coupler_tip", "rocker_tip", name="four-bar")
    assert "rocker/position" in model.constraints_for([crank])


def test_the_loop_is_replaced_by_its_other_branch(model):
    operation = kv.CloseLoop(name="four-bar", frame="coupler_tip", to="rocker_tip", home={"rocker": -1.5})
    with model.edit() as edit:
        edit.replace("loop four-bar", operation)
    np.testing.assert_allclose(meeting(model), four_bar_by_circles(0.7, side=-1), rtol=0, atol=1e-11)


def test_a_loop_follows_an_operation_inserted_before(model):
    """A crank that is moved on the ground before the loop is closed: the loop is closed anew."""
    ground, attach = kv.translation(0.1, 0, 0), four_bar(close=False)
    with attach.edit() as edit:
        edit.attach("crank", "world", [ground, kv.rotation_z(crank)], tag="moved")
    operation = attach.history.entry("moved").operation
    with model.edit() as edit:
        edit.insert(operation, "moved", before="loop four-bar")
    assert list(model.history.tags)[-2:] == ["moved", "loop four-bar"]
    np.testing.assert_allclose(meeting(model) - [0.1, 0], four_bar_by_circles(0.7, d=0.9), rtol=0, atol=1e-11)


def test_later_operations_keep_a_loop_closed(model):
    solution = model.rates.dependent[rocker]
    with model.edit() as edit:
        edit.add_frame("hand", "world", kv.translation(0, 0, kv.position("lift")))
        edit.add_frame("cup", "rocker_tip", kv.translation(0, 0, 0.1))
        edit.constrain("crank/position", -1, crank, 1)
    assert model.rates.dependent[coupler] != solution
    assert set(model.fk("cup").symbols) == {crank}
    assert model.limits(crank) == (-1, 1)
    assert_closed(model, 100)


def test_reads_and_writes_are_known(model):
    (writer,) = model.history.writers("rates/rocker")
    assert writer == "loop four-bar"
    assert "loop four-bar" in model.history.readers("frames/coupler_tip")


def test_listeners_hear(model):
    heard = []
    model.listen(lambda diff: heard.append(("loop", diff.paths)), tags=["loop four-bar"])
    model.listen(lambda diff: heard.append(("rocker", diff.paths)), paths=["rates/rocker"])
    model.listen(lambda diff: heard.append(("hand", diff.paths)), paths=["frames/hand"])
    with model.edit() as edit:
        edit.replace("frame coupler_tip", _frame("coupler_tip", "coupler", 1.12))
    # What follows is another function now, although nobody touched the loop: it was run again.
    assert [who for who, _ in heard] == ["loop", "rocker"]
    assert "rates/rocker" in heard[1][1]
    heard.clear()
    with model.edit() as edit:
        edit.remove("loop four-bar")
    assert {who for who, _ in heard} == {"loop", "rocker"}
    heard.clear()
    with pytest.raises(kv.KineverseError), model.edit() as edit:
        edit.close_loop("coupler_tip", "crank", name="impossible")
    assert not heard


# -- copies and documents ----------------------------------------------------------------------------------


def bits(model, prefix=""):
    """Return what follows, and a Jacobian, in many places, as bytes."""
    angles = np.linspace(-7, 7, 30)[:, None]
    found = function(model, dependent(model), model.jacobian(f"{prefix}coupler_tip")).batch(angles)
    return [f.tobytes() for f in found]


def test_copies_and_pickles(limited):
    model = limited
    for other in (model.copy(), pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        assert other.snapshot() == model.snapshot()
        assert bits(other) == bits(model)
    frozen = model.snapshot()
    with model.edit() as edit:
        edit.remove("loop four-bar")
    assert set(frozen.symbols) == {crank}
    assert set(model.symbols) == {crank, coupler, rocker}
    assert pickle.loads(pickle.dumps(frozen)) == frozen


def test_made_twice_it_is_the_same(limited, model):
    again = limited_four_bar()
    assert again.snapshot() == limited.snapshot()
    assert bits(again) == bits(limited)
    assert model.snapshot() != four_bar(branch=1).snapshot()


@pytest.mark.parametrize(
    "name",
    [
        "four-bar",
        pytest.param("scissor lift", marks=pytest.mark.long),
        "desk lamp",
        pytest.param("parallel gripper", marks=pytest.mark.long),
    ],
)
def test_documents_keep_every_bit(name, tmp_path):
    model, path = GALLERY[name](), tmp_path / "linkage.kv.json"
    model.save(path)
    read = kv.load(path)
    assert read.snapshot() == model.snapshot()
    assert read.degrees_of_freedom == model.degrees_of_freedom
    assert read.default_state() == model.default_state()
    points = np.random.default_rng(0).uniform(0.2, 0.9, (20, len(model.degrees_of_freedom)))
    for frame in model.frames:
        poses = model.fk(frame), read.fk(frame)
        ours, theirs = (function(model, e, *e.gradient().values()).batch(points) for e in poses)
        assert [e.tobytes() for e in ours] == [e.tobytes() for e in theirs]
        jacobians = (function(m, m.jacobian(frame)).batch(points)[0] for m in (model, read))
        np.testing.assert_allclose(*jacobians, rtol=0, atol=1e-14)
    loop = next(a for a in model.articulations if model.articulations[a].kind == "closedloop")
    assert record(read, loop) == record(model, loop)
    read.save(tmp_path / "again.kv.json")
    assert (tmp_path / "again.kv.json").read_bytes() == path.read_bytes()


def test_documents_under_a_prefix(tmp_path, limited):
    model = limited
    model.save(tmp_path / "bars.kv.json")
    read = kv.load(tmp_path / "bars.kv.json", prefix="left")
    assert read.degrees_of_freedom == (kv.position("left/crank"),)
    assert set(read.rates.dependent) == {kv.position("left/coupler"), kv.position("left/rocker")}
    assert bits(read, "left/") == bits(model)
    assert "left/rocker/position" in [v.name for v in read.violations({"left/crank": 3.0})]
    both = kv.Model()
    both.include(tmp_path / "bars.kv.json", prefix="left")
    both.include(tmp_path / "bars.kv.json", prefix="right")
    assert both.degrees_of_freedom == (kv.position("left/crank"), kv.position("right/crank"))
    for side in ("left", "right"):
        found = both.fk(f"{side}/rocker_tip")({f"{side}/crank": 0.4})
        assert found.tobytes() == model.fk("rocker_tip")({"crank": 0.4}).tobytes()
        with pytest.raises(kv.errors.NoSolutionError, match="four-bar"):
            both.fk(f"{side}/rocker_tip")({f"{side}/crank": np.inf})


def test_names_with_colons_have_limits_too():
    model = kv.Model()
    with model.edit() as edit:
        for name, parent, x in (("a:0", "world", 0.0), ("a:1", "a:0", 0.4), ("a:2", "world", 1.0)):
            origin = kv.model.Pose.from_matrix(kv.translation(x, 0, 0))
            limits = {"lower": -0.3, "upper": 0.3} if name == "a:0" else {}
            edit.apply(
                kv.Revolute(name=name, parent=parent, child=name, axis=(0, 0, 1), origin=origin, **limits)
            )
            edit.add_frame(f"{name} end", parent=name, transform=kv.translation(0.5, 0, 0))
        # It closes within the limits, and not all around.
        edit.close_loop("a:1 end", "a:2 end", home={"a%3A1": 1.0, "a%3A2": 2.0})
    assert [str(s) for s in model.degrees_of_freedom] == ["a%3A0"]
