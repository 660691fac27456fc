"""Parts of models agree with the whole, and replicas that follow their views stay equal to them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import adopt, check_agreement, close, make_replica
from replicas import Replica

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse import gallery
from kineverse.exchange.authority import Authority
from kineverse.exchange.protocol import Changes, Decoder, Refused, encode
from kineverse.exchange.store import Store
from kineverse.exchange.views import Coupling, View, Views, Wish
from kineverse.formats.document import document_hash, to_bytes
from kineverse.gallery.lockboxes import draw_tangled_lockbox, make_lockbox_model
from kineverse.model import Edit
from kineverse.model.basic_operations import SetBody, SetHome
from kineverse.model.model import Snapshot
from kineverse.model.operation import BODIES, FRAMES


def check_parts(model: kv.Model, frames: Sequence[str]) -> None:
    views = Views(model)
    for frame in frames:
        check_agreement(model, make_replica(views.add(Wish((frame,)))), [frame])
    if frames:
        check_agreement(model, make_replica(views.add(Wish(tuple(frames)))), frames)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", gallery.names())
def test_the_part_of_a_frame_agrees_with_the_scene(name: str) -> None:
    model = kv.load(f"articulations/{name}")
    frames = list(model.frames)
    check_parts(model, frames if len(frames) < 9 else frames[-1:])


@pytest.mark.parametrize("name", ["kitchen", "fetch", "hsr", "pr2"])
def test_the_part_of_a_frame_agrees_with_the_description(name: str) -> None:
    model = kv.load(name)
    frames = list(model.frames)
    check_parts(model, [frames[-1], frames[len(frames) // 2]])


@pytest.mark.long
@pytest.mark.parametrize("name", ["kitchen", "fetch", "hsr", "pr2", *(f"kitchens/{i}" for i in range(4))])
def test_the_part_of_each_frame_agrees_with_the_description(name: str) -> None:
    model = kv.load(name)
    check_parts(model, list(model.frames))


@pytest.mark.parametrize("name", ["thesis", "rings-3"])
def test_the_part_of_a_frame_agrees_with_the_lockbox(name: str) -> None:
    model = kv.load(f"lockboxes/{name}")
    check_parts(model, list(model.frames)[:2])


@settings(max_examples=attempts(4, long=30))
@given(st.integers(0, 1000))
def test_the_part_of_a_coordinate_agrees_with_a_tangled_lockbox(seed: int) -> None:
    model = make_lockbox_model(draw_tangled_lockbox(5, seed))
    view = Views(model).add(Wish((), ("lockbox/" + str(model.symbols[0]).rpartition("/")[2],)))
    check_agreement(model, make_replica(view), [], view.wish.symbols)


# -- what is in a part ---------------------------------------------------------------------------------------


def furniture() -> kv.Model:
    """Return a cabinet with a door and its bolt, a drawer, and a robot of one joint on a drive."""
    model = kv.Model()
    door, bolt = kv.position("door"), kv.position("bolt")
    box = kv.model.Body((kv.model.Shape(kv.model.Box((0.1, 0.1, 0.1))),))
    with model.edit() as edit:
        edit.add_frame("cabinet", "world", kv.translation(2, 0, 0), body=box)
        edit.add_frame("cabinet/door", "cabinet", kv.rotation_z(door), body=box)
        edit.add_frame("cabinet/door/handle", "cabinet/door", kv.translation(0.4, 0, 0), body=box)
        edit.constrain("door/range", 0, door, kv.where(bolt > 0.5, 1.5, 0))
        edit.constrain("bolt/range", 0.2, bolt, 1)
        edit.add_frame("cabinet/drawer", "cabinet", kv.translation(kv.position("drawer"), 0, 0), body=box)
        edit.constrain("drawer/range", 0, kv.position("drawer"), 0.5)
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="drive", parent="world", child="robot", radius=0.1, track=0.4, wheel_speed=3
            )
        )
        edit.apply(
            kv.Revolute(
                name="arm", parent="robot", child="robot/hand", axis=(0, 0, 1), lower=-1, upper=1, velocity=1
            )
        )
        edit.write("note", "nothing")
    return model


def test_a_part_has_what_its_frames_need() -> None:
    cells = close(furniture(), Wish(("cabinet/door/handle",)))
    assert {name for kind, name in cells if kind == FRAMES} == {
        "cabinet",
        "cabinet/door",
        "cabinet/door/handle",
    }
    assert {name for kind, name in cells if kind == BODIES} == {"cabinet/door/handle"}
    assert {name for kind, name in cells if kind == "constraints"} == {"door/range", "bolt/range"}
    assert not {name for kind, name in cells if kind == "data"}


def test_a_name_with_a_slash_stands_for_the_frames_below_it() -> None:
    model = furniture()
    cells = close(model, Wish(("cabinet/door/",), bodies=False))
    assert sorted(name for kind, name in cells if kind == FRAMES) == [
        "cabinet",
        "cabinet/door",
        "cabinet/door/handle",
    ]
    assert ("frames", "cabinet/drawer") in close(model, Wish(("cabinet/",)))
    assert close(model, Wish(("world",))) == set()


def test_a_part_is_much_smaller_than_a_kitchen_with_a_robot() -> None:
    model = kv.load("kitchen")
    model.include("pr2")
    view = Views(model).add(Wish(("kitchen/fridge_door_handle",), bodies=False))
    assert len(to_bytes(Snapshot({}, view.entries, 0))) < 0.01 * len(to_bytes(model))


@pytest.mark.parametrize(
    ("wish", "message"),
    [
        (Wish(("cabinet/dor",)), "There is no frame 'cabinet/dor'.*cabinet/door"),
        (Wish(("cabnet/",)), "There is no frame below 'cabnet/'.*cabinet/"),
        (Wish((), ("dor",)), "There is no symbol 'dor'.*door"),
    ],
)
def test_an_unknown_name_is_refused_with_similar_ones(wish: Wish, message: str) -> None:
    views = Views(furniture())
    with pytest.raises(kv.errors.UnknownNameError, match=message):
        views.add(wish)
    assert [*views] == []


def test_equal_wishes_share_a_view_until_the_last_is_released() -> None:
    views = Views(furniture())
    one, other = views.add(Wish(("cabinet", "robot"))), views.add(Wish(("robot", "cabinet", "robot")))
    assert one is other
    assert views.add(Wish(("cabinet", "robot"), bodies=False)) is not one
    views.release(one)
    assert views.get(one.id) is one
    views.release(other)
    assert views.get(one.id) is None


def test_a_part_has_the_limits_of_what_shares_its_wheels() -> None:
    model = furniture()
    with model.edit() as edit:
        edit.add_frame("compass", "world", kv.rotation_z(kv.position("drive/angle")))
        edit.constrain("drive/slow", -1, kv.velocity("drive/x"), 1)
    part = make_replica(Views(model).add(Wish(("compass",))))
    assert "drive/slow" in part.velocity_rows(0.01, "compass").names
    check_agreement(model, part, ["compass"])


def test_a_part_has_what_moves_it_by_a_gradient_alone() -> None:
    model = furniture()
    angle = kv.position("sensor").augment({kv.velocity("motor"): 1.0})
    with model.edit() as edit:
        edit.add_frame("needle", "world", kv.rotation_z(angle))
        edit.constrain("motor/gentle", -1, kv.velocity("motor"), 1)
    part = make_replica(Views(model).add(Wish(("needle",))))
    assert list(part.constraints) == ["motor/gentle"]
    check_agreement(model, part, ["needle"])


def test_a_part_has_the_records_of_its_frames_and_coordinates() -> None:
    model = furniture()
    with model.edit() as edit:
        edit.apply(kv.Fixed(name="glue", parent="robot/hand", child="tool"))
        edit.apply(SetHome("arm", (0.5,)))
    part = make_replica(Views(model).add(Wish(("tool",))))
    assert dict(part.articulations) == dict(model.articulations)
    assert part.default_state()["arm"] == 0.5


def test_a_frame_that_was_attached_elsewhere_has_its_last_value() -> None:
    model = furniture()
    with model.edit() as edit:
        edit.add_frame("knob", "cabinet/door/handle")
        edit.attach("cabinet/door/handle", "robot/hand", kv.translation(0, 0, 0.1))
    part = make_replica(Views(model).add(Wish(("knob",))))
    assert "cabinet/door" not in part.frames
    check_agreement(model, part, ["knob", "cabinet/door/handle"])
    assert part.history.tags == [tag for tag in model.history.tags if tag in {*part.history.tags}]


def test_operations_of_a_part_say_why_they_cannot_be_run_again() -> None:
    replica = make_replica(Views(furniture()).add(Wish(("cabinet/door",))))
    reason = "AddFrame was made from it: only a part of it is here"
    with pytest.raises(kv.errors.EditError, match=reason), replica.edit() as edit:
        edit.remove("frame cabinet")


@pytest.mark.parametrize("is_run_again", [False, True])
def test_an_operation_of_a_part_is_not_put_into_the_whole(is_run_again: bool) -> None:
    def build(edit: Edit) -> None:
        edit.add_frame("box", "world", kv.rotation_z(kv.position("lid")), body=kv.model.Body(), tag="box")
        edit.add_frame("lid", "box", body=kv.model.Body(), tag="lid")

    def move(edit: Edit) -> None:
        if is_run_again:  # the frame below it looks whether it is there again
            edit.remove("box")
            box = kv.model.AddFrame("box", kv.model.Frame("world", ()))
            edit.insert(box, "another", before="lid")
        else:
            lid = edit.model.history.operation("lid")
            edit.remove("lid")
            edit.apply(lid, "lid")

    authority = Authority(Store(None))
    authority.fill(build, "me")
    replica = Replica(authority)
    replica.model = make_replica(Views(authority.model).add(Wish(("lid",), bodies=False)))
    before = document_hash(authority.model)
    (result,) = authority.process([replica.draft(move)])
    assert isinstance(result.answer, Refused)
    assert "load the whole model" in result.answer.message
    assert document_hash(authority.model) == before


# -- commits -------------------------------------------------------------------------------------------------


class Followed:
    """A model with views, and a replica for each that adopts what it is sent."""

    def __init__(self, model: kv.Model, *wishes: Wish) -> None:
        self.model = model
        self.views = Views(model)
        self.replicas = [(view, make_replica(view)) for view in map(self.views.add, wishes)]
        self.diffs: list[kv.model.Diff] = []
        model.listen(self.diffs.append)

    def publish(self) -> list[Changes]:
        """Send what the commits since the last call have changed, and compare with parts made anew."""
        changed = {view.id: changes for view, changes in self.views.commit(*self.diffs)}
        self.diffs.clear()
        for view, replica in self.replicas:
            if view.id in changed:
                adopt(replica, changed[view.id])
            anew = View(self.model, Coupling(self.model.history), view.wish)
            assert document_hash(replica) == document_hash(Snapshot({}, anew.entries, 0))
            assert replica.history.tags == [entry.tag for entry in anew.entries]
        return list(changed.values())

    def check(self) -> None:
        """Check that the replicas agree with the model."""
        for view, replica in self.replicas:
            frames = [name for name in view.wish.frames if name in self.model.frames]
            check_agreement(self.model, replica, frames, rows=False)


def test_a_commit_elsewhere_concerns_no_view() -> None:
    followed = Followed(furniture(), Wish(("cabinet/door/handle",)), Wish((), ("door",)))
    with followed.model.edit() as edit:
        edit.add_frame("cabinet/drawer/handle", "cabinet/drawer")
        edit.constrain("drawer/gentle", -1, kv.velocity("drawer"), 1)
        edit.write("another note", "something")
    assert followed.publish() == []


def test_cells_come_and_leave_when_a_frame_is_attached_elsewhere() -> None:
    followed = Followed(furniture(), Wish(("cabinet/door/handle",)))
    ((_, replica),) = followed.replicas
    with followed.model.edit() as edit:
        edit.attach("cabinet/door/handle", "robot/hand", kv.translation(0, 0, 0.1))
    followed.publish()
    followed.check()
    assert {*replica.frames} == {"cabinet/door/handle", "robot", "robot/hand"} | {
        name for name in followed.model.frames if name.startswith("drive")
    }
    assert "door/range" not in replica.constraints
    with followed.model.edit() as edit:
        edit.remove("attach cabinet/door/handle to robot/hand")
    followed.publish()
    followed.check()
    assert {*replica.constraints} == {"door/range", "bolt/range"}


def enter(edit: Edit, what: str) -> None:
    """Add something that concerns the handle of the door, or the bolt that locks it."""
    if what == "constraint":
        edit.constrain("door/gentle", -1, kv.velocity("door"), 1)
    elif what == "constraint of the bolt":
        edit.constrain("bolt/gentle", -1, kv.velocity("bolt"), 1)
    elif what == "rate":
        edit.set_rate(kv.position("bolt"), {kv.velocity("motor"): 2.0})
    elif what == "dependence":
        edit.apply(Depend(kv.position("bolt"), kv.position("crank")))
    elif what == "record":
        edit.apply(Record("door", "robot", "elsewhere", (kv.position("door"),), (0.3,)))
    elif what == "record of a frame":
        edit.apply(Record("glue", "cabinet", "cabinet/door/handle"))
    elif what == "first body":
        edit.apply(SetBody("cabinet/knob", kv.model.Body()))
    elif what == "body":
        edit.apply(SetBody("cabinet/door/handle", kv.model.Body()), override=True)
    else:
        edit.add_frame("cabinet/shelf", "world", kv.translation(kv.position("shelf"), 0, 0))


@dataclass(frozen=True)
class Record(kv.Operation):
    """A record of an articulation."""

    name: str
    parent: str
    child: str
    coordinates: tuple[kv.Symbol, ...] = ()
    home: tuple[float, ...] = ()

    def apply(self, model: Any) -> kv.model.Writes:
        record = kv.model.Articulation("hinge", self.parent, self.child, self.coordinates, self.home)
        return kv.model.Writes(articulations={self.name: record})


@pytest.mark.parametrize(
    "what",
    [
        "constraint",
        "constraint of the bolt",
        "rate",
        "dependence",
        "record",
        "record of a frame",
        "body",
        "first body",
        "frame below a prefix",
    ],
)
def test_what_enters_a_part_is_sent(what: str) -> None:
    model = furniture()
    with model.edit() as edit:
        edit.add_frame("cabinet/knob", "cabinet/door")
    followed = Followed(model, Wish(("cabinet/",)), Wish((), ("drawer",)))
    with model.edit() as edit:
        enter(edit, what)
    (changes,) = followed.publish()
    assert decode_changes(encode(changes)) == changes
    followed.check()
    with model.edit() as edit:
        edit.remove(model.history.tags[-1])
    assert len(followed.publish()) == 1
    followed.check()


decode_changes = Decoder(Changes, "The changes")


def test_a_wished_frame_that_is_removed_comes_back() -> None:
    followed = Followed(furniture(), Wish(("cabinet/door/handle", "cabinet/drawer"), ("bolt",)))
    ((_, replica),) = followed.replicas
    with followed.model.edit() as edit:
        edit.remove("frame cabinet/door/handle")
    followed.publish()
    assert {*replica.frames} == {"cabinet", "cabinet/drawer"}
    with followed.model.edit() as edit:
        edit.remove("constraint bolt/range")
        edit.remove("constraint door/range")
    followed.publish()
    assert not any("bolt" in name for name in replica.constraints)
    with followed.model.edit() as edit:
        edit.constrain("bolt/range", 0, kv.position("bolt"), 1)
    assert len(followed.publish()) == 1
    with followed.model.edit() as edit:
        edit.add_frame("cabinet/door/handle", "cabinet/door", kv.translation(0.3, 0, 0))
    assert len(followed.publish()) == 1
    followed.check()
    assert {"cabinet/door", "cabinet/door/handle"} <= {*replica.frames}
    assert "bolt/range" in replica.constraints


def test_what_was_overwritten_and_is_removed_is_removed_from_the_part() -> None:
    followed = Followed(furniture(), Wish(("cabinet/drawer",)))
    ((_, replica),) = followed.replicas
    with followed.model.edit() as edit:
        edit.add_frame("cabinet/drawer", "world", tag="again", override=True)
    followed.publish()
    with followed.model.edit() as edit:
        edit.remove("frame cabinet/drawer")
    (changes,) = followed.publish()
    assert changes.removed == ("frame cabinet/drawer",)
    assert replica.history.tags == ["again"]
    followed = Followed(followed.model, Wish(("cabinet/drawer",)))
    ((_, replica),) = followed.replicas
    with followed.model.edit() as edit:
        drawer = kv.model.AddFrame("cabinet/drawer", kv.model.Frame("cabinet", ()))
        edit.insert(drawer, before="again")
    followed.publish()
    assert replica.frames["cabinet/drawer"].parent == "world"
    followed.check()


@dataclass(frozen=True)
class Same(kv.Operation):
    """Another kind of operation that writes a given frame."""

    name: str
    frame: kv.model.Frame

    def apply(self, model: Any) -> kv.model.Writes:
        return kv.model.Writes(frames={self.name: self.frame})


def test_another_kind_of_operation_is_sent_though_it_writes_the_same() -> None:
    followed = Followed(furniture(), Wish(("cabinet/drawer",), bodies=False))
    with followed.model.edit() as edit:
        edit.replace("frame cabinet/drawer", Same("cabinet/drawer", edit.model.frames["cabinet/drawer"]))
    (changes,) = followed.publish()
    assert changes.replaced == ("frame cabinet/drawer",)


def test_commits_while_nobody_follows_are_in_later_views() -> None:
    followed = Followed(furniture(), Wish(("cabinet/door",)))
    views, ((view, _),) = followed.views, followed.replicas
    views.release(view)
    with followed.model.edit() as edit:
        edit.constrain("door/gentle", -1, kv.velocity("door"), 1)
    assert views.commit(*followed.diffs) == []
    part = make_replica(views.add(view.wish))
    check_agreement(followed.model, part, ["cabinet/door"])
    assert "door/gentle" in part.constraints


def test_operations_at_the_same_place_keep_their_order_when_places_are_renumbered() -> None:
    followed = Followed(furniture(), Wish(("cabinet/",)))
    for i in range(40):
        with followed.model.edit() as edit:
            edit.insert(
                kv.model.AddFrame(f"cabinet/f{i}", kv.model.Frame.from_transform("cabinet", np.eye(4))),
                before="frame cabinet/door",
            )
    (changes,) = followed.publish()
    assert len(changes.put) == 40


COORDINATES = ("door", "bolt", "drawer", "arm", "free", "drive/x", "drive/angle", "drive/left_wheel")
NAMES = ("cabinet", "cabinet/door", "cabinet/door/handle", "cabinet/drawer", "robot", "robot/hand", "a", "b")
PLACES = (*NAMES, "world")
coordinate = st.sampled_from(COORDINATES).map(kv.position)
action = st.one_of(
    st.tuples(st.just("attach"), st.sampled_from(NAMES), st.sampled_from(PLACES), coordinate),
    st.tuples(st.just("frame"), st.sampled_from(NAMES), st.sampled_from(PLACES), coordinate),
    st.tuples(st.just("constrain"), st.sampled_from("cde"), coordinate, coordinate),
    st.tuples(st.just("row"), coordinate, coordinate, coordinate),
    st.tuples(st.just("depend"), coordinate, coordinate),
    st.tuples(st.just("home"), st.sampled_from((-0.5, 0.5))),
    st.tuples(st.just("body"), st.sampled_from(NAMES)),
    st.tuples(st.just("remove"), st.integers(0, 40)),
    st.tuples(st.just("move"), st.integers(0, 40), st.integers(0, 40)),
    st.tuples(st.just("replace"), st.integers(0, 40), st.sampled_from(PLACES), coordinate),
)


REFUSALS = (
    kv.errors.EditError,
    kv.errors.ModelError,
    kv.errors.DuplicateNameError,
    kv.errors.UnknownNameError,
)


def do(edit: Edit, kind: str, *what: Any) -> None:
    """Do one thing in an edit."""
    tags = edit.model.history.tags
    count = max((int(t[1:]) for t in tags if t[1:].isdigit()), default=0) + 1
    if kind == "attach":
        edit.attach(what[0], what[1], kv.rotation_z(what[2]), tag=f"t{count}")
    elif kind == "frame":
        edit.add_frame(what[0], what[1], kv.rotation_z(what[2]), tag=f"t{count}", override=bool(count % 2))
    elif kind == "constrain":
        edit.constrain(what[0], -1, what[1], kv.where(what[2] > 0.5, 1, 0.5), tag=f"t{count}")
    elif kind == "row":
        row = {what[1].derivative(): np.cos(what[2])}
        edit.set_rate(what[0], row, tag=f"t{count}", override=True)
    elif kind == "depend":
        edit.apply(Depend(what[0], what[1]), tag=f"t{count}", override=True)
    elif kind == "home":
        edit.apply(SetHome("arm", (what[0],)), tag=f"t{count}")
    elif kind == "body":
        edit.apply(SetBody(what[0], kv.model.Body()), tag=f"t{count}", override=True)
    else:
        tag = tags[what[0] % len(tags)]
        if kind == "remove":
            edit.remove(tag)
        elif kind == "move":
            operation = edit.model.history.operation(tag)
            edit.remove(tag)
            edit.insert(operation, tag, before=edit.model.history.tags[what[1] % (len(tags) - 1)])
        else:
            name = next((n for k, n in edit.model.history.entry(tag).writes if k == FRAMES), "a")
            edit.replace(
                tag, kv.model.AddFrame(name, kv.model.Frame.from_transform(what[1], kv.rotation_x(what[2])))
            )


@dataclass(frozen=True)
class Depend(kv.Operation):
    """Makes a coordinate depend on another."""

    coordinate: kv.Symbol
    on: kv.Symbol

    def apply(self, model: Any) -> kv.model.Writes:
        return kv.model.Writes(rates={self.coordinate: 2 * self.on})


@settings(max_examples=attempts(40, long=400))
@given(st.lists(st.lists(action, min_size=1, max_size=4), min_size=1, max_size=12), st.integers(1, 3))
def test_replicas_that_follow_random_edits_are_equal_to_parts_made_anew(
    edits: list[list[tuple[Any, ...]]], together: int
) -> None:
    followed = Followed(
        furniture(),
        Wish(("cabinet/door/handle",)),
        Wish(("cabinet/",), bodies=False),
        Wish(("robot/hand", "cabinet/drawer"), ("door",)),
        Wish((), ("bolt", "drive/x")),
    )
    for number, actions in enumerate(edits):
        with contextlib.suppress(*REFUSALS), followed.model.edit() as edit:
            for kind, *what in actions:
                with contextlib.suppress(*REFUSALS):
                    do(edit, kind, *what)
        if number % together == 0:
            followed.publish()
    followed.publish()
    followed.check()
