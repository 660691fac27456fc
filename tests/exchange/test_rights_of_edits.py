"""What an edit may write: ways around the prefixes of a right, each of which leads nowhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any

import msgspec
import pytest
from faults import edits
from faults.edits import Capped, Twice
from replicas import Act, Replica, content

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.exchange import protocol
from kineverse.exchange.authority import Authority
from kineverse.exchange.protocol import Changes, Committed, Refused
from kineverse.exchange.rights import EVERYTHING, Right, find_forbidden
from kineverse.exchange.store import Store
from kineverse.model import Edit
from kineverse.model.basic_operations import SetBody, SetData, SetHome
from kineverse.model.body import Body
from kineverse.model.history import History
from kineverse.model.operation import Writes
from kineverse.model.read_recorder import ReadRecorder

CAROL = Right(("kitchen/",), "carol")
DOOR, TORSO = kv.position("kitchen/door"), kv.position("pr2/torso")
WHEEL, MOTOR = kv.velocity("kitchen/wheel"), kv.velocity("pr2/motor")


@dataclass(frozen=True)
class Nothing(kv.Operation):
    """Writes nothing, or a datum."""

    name: str = ""

    def apply(self, model: ReadRecorder) -> Writes:
        return Writes(data={self.name: 1} if self.name else {})


@dataclass(frozen=True)
class Both(kv.Operation):
    """Writes below two prefixes."""

    def apply(self, model: ReadRecorder) -> Writes:
        return Writes(data={"kitchen/both": 1, "pr2/both": 1})


@dataclass(frozen=True)
class Height(kv.Operation):
    """Bounds the height of a frame: it has a trace."""

    name: str
    frame: str

    def apply(self, model: ReadRecorder) -> Writes:
        return Writes(constraints={self.name: (0, model.fk(self.frame)[2, 3], 1)})


@dataclass(frozen=True)
class Record(kv.Operation):
    """Writes a record of an articulation, by which its coordinates get their homes."""

    record: kv.model.Articulation

    def apply(self, model: ReadRecorder) -> Writes:
        return Writes(articulations={"kitchen/fake": self.record})


def build(edit: Edit) -> None:
    for joint in "kitchen/door", "pr2/torso":
        side = joint.partition("/")[0]
        edit.add_frame(f"{side}/base", "world", kv.translation(1, 0, 0), tag=f"{side} base")
        slide = kv.Prismatic(
            name=joint, parent=f"{side}/base", child=joint, axis=(0, 0, 1), lower=0, upper=1, velocity=1
        )
        edit.apply(slide, joint)
        edit.write(f"{side}/level", 1.5, f"{side} level")
    edit.apply(Twice("pr2/twice", "kitchen/level"), "pr2 twice")
    edit.apply(Twice("kitchen/twice", "kitchen/level"), "kitchen twice")
    edit.write("kitchen/cap", 1.0, "kitchen cap")
    edit.write("kitchen/limit", 1.0, "kitchen limit")
    edit.apply(Capped("pr2/capped", "kitchen/limit"), "pr2 capped")
    edit.apply(Nothing(), "nothing")
    edit.constrain("kitchen/clear", 0, DOOR + TORSO, 2, "both clear")
    edit.add_frame("kitchen/cup", "kitchen/door", tag="cup")
    edit.apply(Height("kitchen/height", "kitchen/cup"), "height")


def started() -> tuple[Authority, Replica]:
    authority = Authority(Store(None))
    authority.fill(build, "me")
    return authority, Replica(authority)


def ask(authority: Authority, request: Any, right: Right = CAROL) -> Any:
    (result,) = authority.process([request], [right])
    assert isinstance(result.answer, Committed | Refused)
    return result.answer


def check_forbidden(authority: Authority, request: Any, right: Right = CAROL) -> Refused:
    """Ask for an edit, which must be forbidden, and leave the model as it is."""
    before = content(authority.model), authority.chain, authority.model.snapshot()
    answer = ask(authority, request, right)
    assert isinstance(answer, Refused), answer
    assert answer.reason == "forbidden", answer
    assert "carol may edit below kitchen/" in answer.message
    assert answer.tag
    assert repr(answer.tag) in answer.message
    assert answer.path in answer.message
    assert (content(authority.model), authority.chain, authority.model.snapshot()) == before
    return answer


# -- what is allowed -----------------------------------------------------------------------------------------

ALLOWED: dict[str, Act] = {
    "a new frame": lambda edit: edit.add_frame("kitchen/new", "pr2/base"),
    "to attach to another's": lambda edit: edit.attach("kitchen/base", "pr2/torso", kv.translation(0, 0, 1)),
    "to replace": lambda edit: edit.replace("kitchen cap", SetData("kitchen/other", 1)),
    "to remove": lambda edit: edit.remove("kitchen twice"),
    "to move": lambda edit: move(edit, "kitchen twice", "nothing"),
    "a constraint": lambda edit: edit.constrain("kitchen/c", 0, DOOR, 0.5),
    "a rate": lambda edit: edit.set_rate(DOOR, {WHEEL: 2}),
    "a body": lambda edit: edit.apply(SetBody("kitchen/base", Body())),
    "a home": lambda edit: edit.apply(SetHome("kitchen/door", (0.5,)), override=True),
    "what another's is run again by": lambda edit: edit.replace(
        "kitchen level", SetData("kitchen/level", 2.0)
    ),
}


def move(edit: Edit, tag: str, before: str) -> None:
    operation = edit.model.history.operation(tag)  # type: ignore[attr-defined]
    edit.remove(tag)
    edit.insert(operation, tag, before=before)


@pytest.mark.parametrize("name", ALLOWED)
def test_what_is_below_a_prefix_may_be_edited_and_taken_back(name: str) -> None:
    authority, replica = started()
    first = content(authority.model)
    results = authority.process([replica.draft(ALLOWED[name])], [CAROL])
    assert results[0].commit is not None, results[0].answer
    replica.follow(results)
    assert content(replica.model) == content(authority.model) != first
    assert isinstance(ask(authority, replica.undo(2)), Committed)
    assert content(authority.model) == first


# -- what is not ---------------------------------------------------------------------------------------------

FORBIDDEN: dict[str, tuple[Act, str]] = {
    "a frame of another prefix": (lambda edit: edit.add_frame("pr2/new", "pr2/base"), "frames/pr2/new"),
    "a name with the prefix in it": (
        lambda edit: edit.add_frame("my/kitchen/new", "world"),
        "frames/my/kitchen/new",
    ),
    "a longer prefix": (lambda edit: edit.add_frame("kitchen2/new", "world"), "frames/kitchen2/new"),
    "the prefix alone": (lambda edit: edit.add_frame("kitchen", "world"), "frames/kitchen"),
    "a body of the world": (lambda edit: edit.apply(SetBody("world", Body())), "bodies/world"),
    "to remove another's": (lambda edit: edit.remove("pr2 level"), "data/pr2/level"),
    "to replace another's by one below the prefix": (
        lambda edit: edit.replace("pr2 level", SetData("kitchen/mine", 1)),
        "data/pr2/level",
    ),
    "to replace an own one by one elsewhere": (
        lambda edit: edit.replace("kitchen cap", SetData("pr2/mine", 1)),
        "data/pr2/mine",
    ),
    "to replace another's by its equal": (
        lambda edit: edit.replace("pr2 level", SetData("pr2/level", 1.5)),
        "data/pr2/level",
    ),
    "to move another's": (lambda edit: move(edit, "pr2 level", "kitchen base"), "data/pr2/level"),
    "to attach another's": (
        lambda edit: edit.attach("pr2/base", "kitchen/base", kv.translation(0, 0, 0)),
        "frames/pr2/base",
    ),
    "to write over a datum": (lambda edit: edit.write("pr2/level", 9, "mine"), "data/pr2/level"),
    "to write over a home": (
        lambda edit: edit.apply(SetHome("pr2/torso", (0.5,)), override=True),
        "articulations/pr2/torso",
    ),
    "to write over a rate": (lambda edit: edit.set_rate(TORSO, {WHEEL: 2}), "rates/pr2/torso"),
    "a rate by another's speed": (lambda edit: edit.set_rate(DOOR, {MOTOR: 1}), "rates/kitchen/door"),
    "a rate by another's position": (
        lambda edit: edit.set_rate(DOOR, {WHEEL: TORSO}),
        "rates/kitchen/door",
    ),
    "a limit of another's": (
        lambda edit: edit.constrain("pr2/torso/lower", 0, TORSO, 0.1),
        "constraints/pr2/torso/lower",
    ),
    "a limit of another's by a name below the prefix": (
        lambda edit: edit.constrain("kitchen/c", 0, TORSO, 0.1),
        "constraints/kitchen/c",
    ),
    "another's in a bound": (
        lambda edit: edit.constrain("kitchen/c", TORSO, DOOR, 1),
        "constraints/kitchen/c",
    ),
    "another's in a gradient": (
        lambda edit: edit.constrain("kitchen/c", 0, DOOR.augment({TORSO.derivative(): 1}), 1),
        "constraints/kitchen/c",
    ),
    "to remove a constraint about both": (
        lambda edit: edit.remove("both clear"),
        "constraints/kitchen/clear",
    ),
    "a home of another's by a name below the prefix": (
        lambda edit: edit.apply(
            Record(kv.model.Articulation("x", "world", "kitchen/base", (TORSO,), (9.0,)))
        ),
        "articulations/kitchen/fake",
    ),
    "a record of another's frame": (
        lambda edit: edit.apply(Record(kv.model.Articulation("fixed", "world", "pr2/base"))),
        "articulations/kitchen/fake",
    ),
    "what writes below two prefixes": (lambda edit: edit.apply(Both()), "data/pr2/both"),
    "what writes nothing": (lambda edit: edit.apply(Nothing(), "more"), ""),
    "to remove what writes nothing": (lambda edit: edit.remove("nothing"), ""),
    "to replace what writes nothing": (
        lambda edit: edit.replace("nothing", SetData("kitchen/mine", 1)),
        "",
    ),
    "to empty what writes": (lambda edit: edit.replace("kitchen cap", Nothing()), ""),
    "a constraint that comes to be about another's": (
        lambda edit: edit.replace("cup", kv.model.AddFrame("kitchen/cup", kv.model.Frame("pr2/torso", ()))),
        "constraints/kitchen/height",
    ),
    "one of several": (
        lambda edit: (edit.write("kitchen/fine", 1, "fine"), edit.remove("pr2 level")),
        "data/pr2/level",
    ),
}


@pytest.mark.parametrize("name", FORBIDDEN)
def test_what_is_not_below_a_prefix_is_forbidden_and_nothing_happens(name: str) -> None:
    act, path = FORBIDDEN[name]
    authority, replica = started()
    request = replica.draft(act)
    assert check_forbidden(authority, request).path == path
    replica.number += 1
    allowed = msgspec.structs.replace(request, number=replica.number)
    assert isinstance(ask(authority, allowed, EVERYTHING), Committed)


def test_to_remove_what_others_need_is_forbidden_before_the_model_refuses_it() -> None:
    authority, replica = started()
    request = replica.request(Changes(removed=("pr2 base",)))
    assert check_forbidden(authority, request).path == "frames/pr2/base"
    assert ask(authority, replica.request(Changes(removed=("pr2 base",))), EVERYTHING).reason == "refused"


def test_a_right_to_see_edits_nothing() -> None:
    authority, replica = started()
    answer = ask(authority, replica.draft(ALLOWED["a new frame"]), Right((), "bob"))
    assert answer.reason == "forbidden"
    assert "bob may see, and not edit" in answer.message


def test_a_refused_edit_is_answered_alike_and_does_not_hold_up_others() -> None:
    authority, replica = started()
    bad, good = replica.draft(FORBIDDEN["to remove another's"][0]), replica.draft(ALLOWED["a rate"])
    dave = Right(("pr2/",), "dave")
    answers = [one.answer for one in authority.process([bad, good, bad], [CAROL, CAROL, dave])]
    assert isinstance(answers[1], Committed)
    assert answers[0] == answers[2] == ask(authority, bad)
    assert answers[0].reason == "forbidden"


# -- lies ----------------------------------------------------------------------------------------------------


def changed(request: protocol.EditRequest, change: Callable[[Any], object], tag: str) -> protocol.EditRequest:
    """Return a request with another content of the blob of an operation."""
    put = []
    for placed in request.changes.put:
        if protocol.tag_of(placed) == tag:
            value = msgspec.msgpack.decode(placed.blob)
            change(value)
            placed = msgspec.structs.replace(placed, blob=msgspec.msgpack.encode(value))
        put.append(placed)
    return with_changes(request, put=tuple(put))


def with_changes(request: protocol.EditRequest, **changes: Any) -> protocol.EditRequest:
    return msgspec.structs.replace(request, changes=msgspec.structs.replace(request.changes, **changes))


def write_elsewhere(value: Any) -> None:
    """Let the trace of an operation write another name than the operation says."""
    (written,) = value["trace"]["writes"]["data"].values()
    value["trace"]["writes"]["data"] = {"pr2/level": written}


def set_level(edit: Edit) -> object:
    return edit.replace("kitchen level", SetData("kitchen/level", 2.0))


def test_a_trace_that_writes_elsewhere_is_forbidden() -> None:
    authority, replica = started()
    request = replica.draft(lambda edit: edit.apply(Twice("kitchen/n", "kitchen/level"), "n"))
    lie = changed(request, write_elsewhere, "n")
    assert check_forbidden(authority, lie).path == "data/pr2/level"


def test_what_is_said_to_be_run_again_is_not_believed_elsewhere() -> None:
    authority, replica = started()
    request = replica.draft(set_level)
    assert {*request.changes.rerun} == {"pr2 twice", "kitchen twice"}
    lie = changed(request, lambda value: value["writes"]["data"].update({"pr2/twice": 99.0}), "pr2 twice")
    lie = changed(lie, write_elsewhere, "pr2 twice")
    results = authority.process([lie], [CAROL])
    assert isinstance(results[0].answer, Committed), results[0].answer
    assert authority.model.data["pr2/twice"] == authority.model.data["kitchen/twice"] == 4.0
    assert authority.model.data["pr2/level"] == 1.5
    replica.follow(results)
    assert content(replica.model) == content(authority.model)


def test_an_own_operation_that_is_run_again_cannot_come_to_write_elsewhere() -> None:
    authority, replica = started()
    lie = changed(replica.draft(set_level), write_elsewhere, "kitchen twice")
    assert check_forbidden(authority, lie).path == "data/pr2/level"


def test_what_only_the_client_can_run_again_is_refused_elsewhere_and_taken_below_the_prefix() -> None:
    authority, replica = started()
    request = replica.draft(
        lambda edit: (
            edit.replace("pr2 capped", Capped("pr2/capped", "kitchen/limit")),
            edit.replace("kitchen limit", SetData("kitchen/limit", 5.0)),
        )
    )
    # As one asks who has the code of what reads it.
    request = with_changes(request, replaced=("kitchen limit",), rerun=("pr2 capped",))
    answer = ask(authority, request)
    assert (answer.reason, answer.tag) == ("refused", "pr2 capped")
    both = Right(("kitchen/", "pr2/"), "carol")
    results = authority.process([msgspec.structs.replace(request, number=50)], [both])
    assert isinstance(results[0].answer, Committed)
    assert authority.model.data["pr2/capped"] == 2


def test_an_edit_of_anothers_operation_is_not_passed_off_as_a_run() -> None:
    authority, replica = started()
    request = replica.draft(
        lambda edit: (set_level(edit), edit.replace("pr2 level", SetData("pr2/level", 9.0)))
    )
    moved = replica.draft(lambda edit: (set_level(edit), move(edit, "pr2 twice", "kitchen twice")))
    for lie in (
        with_changes(request, rerun=(*request.changes.rerun, "pr2 level"), replaced=("kitchen level",)),
        with_changes(request, rerun=(*request.changes.rerun, "pr2 level")),
        with_changes(moved, rerun=("pr2 twice", "kitchen twice")),
    ):
        before = content(authority.model)
        assert ask(authority, lie).reason in ("refused", "forbidden")
        assert content(authority.model) == before


def set_parameters(value: Any, **parameters: Any) -> None:
    value["parameters"].update(parameters)


@pytest.mark.parametrize("trigger", [True, False], ids=["by an own edit", "by one of others"])
def test_parameters_that_write_elsewhere_when_an_operation_is_made_again_are_forbidden(trigger: bool) -> None:
    authority, replica = started()
    request = replica.draft(lambda edit: edit.apply(SetBody("kitchen/base", Body()), "bomb"))
    fuse = "data/kitchen/fuse" if trigger else "data/pr2/level"

    def lie(value: Any) -> None:
        set_parameters(value, name="pr2/base")
        value["reads"].setdefault("value", []).append(fuse)

    assert check_forbidden(authority, changed(request, lie, "bomb")).path == "bodies/pr2/base"
    missing = changed(request, lambda value: set_parameters(value, name="pr2/later"), "bomb")
    answer = ask(authority, msgspec.structs.replace(missing, number=7))
    assert (answer.reason, answer.tag) == ("refused", "bomb")
    assert "parameters" in answer.message


def test_the_name_of_a_rate_is_that_of_its_coordinate() -> None:
    authority, replica = started()
    request = replica.draft(lambda edit: edit.set_rate(TORSO, {WHEEL: 2}, "rate"))

    def lie(value: Any) -> None:
        value["writes"]["rates"] = {"kitchen/door": value["writes"]["rates"]["pr2/torso"]}

    assert ask(authority, changed(request, lie, "rate")).reason == "malformed"


def test_an_empty_tag_or_name_is_no_way_out() -> None:
    authority, replica = started()
    request = replica.draft(lambda edit: edit.write("kitchen/x", 1, "x"))
    assert ask(authority, changed(request, lambda value: value.update(tag=""), "x")).reason == "malformed"
    with pytest.raises(kv.errors.FormatError):
        protocol.decode_request(protocol.encode(with_changes(request, removed=("",))))
    for name in "kitchen/", "kitchen//x", "", "kitchen/../pr2/level":
        lie = changed(request, lambda value, name=name: value["writes"].update(data={name: 1}), "x")  # type: ignore[misc]
        replica.number += 1
        answer = ask(authority, msgspec.structs.replace(lie, number=replica.number))
        if isinstance(answer, Committed):  # dots mean nothing in a name
            assert name == "kitchen/../pr2/level"
    assert authority.model.data["pr2/level"] == 1.5


# -- tags, undo ----------------------------------------------------------------------------------------------


def test_a_tag_is_of_the_first_who_takes_it_and_whoever_edits_everything_frees_it() -> None:
    authority, replica = started()
    dave, other = Right(("pr2/",), "dave"), Replica(authority, "b")
    results = authority.process(
        [replica.draft(lambda edit: edit.write("kitchen/x", 1, "frame pr2/arm"))], [CAROL]
    )
    other.follow(results)
    with pytest.raises(kv.errors.DuplicateNameError, match="taken"):
        other.draft(lambda edit: edit.add_frame("pr2/arm", "pr2/base"))
    free = other.draft(lambda edit: edit.remove("frame pr2/arm"))
    assert ask(authority, free, dave).reason == "forbidden"
    assert isinstance(ask(authority, msgspec.structs.replace(free, number=9), EVERYTHING), Committed)


@pytest.mark.parametrize("is_restarted", [False, True])
def test_undo_needs_the_right_for_what_it_restores(is_restarted: bool) -> None:
    store = Store(None)
    authority = Authority(store)
    authority.fill(build, "me")
    alice = Replica(authority, "a")
    for act in (
        FORBIDDEN["to write over a datum"][0],
        FORBIDDEN["one of several"][0],
        lambda edit: edit.replace("kitchen cap", SetData("kitchen/other", 1)),
        lambda edit: edit.remove("kitchen twice"),
    ):
        results = authority.process([alice.draft(act)])
        assert isinstance(results[0].answer, Committed), results[0].answer
        alice.follow(results)
    if is_restarted:
        authority = Authority(store)
    carol = Replica(authority, "c")
    for revision in 2, 3:
        check_forbidden(authority, carol.undo(revision))
    for revision in 5, 4:  # others have made them, below the prefix
        assert isinstance(ask(authority, carol.undo(revision)), Committed)
    before = content(authority.model)
    assert ask(authority, carol.undo(3), EVERYTHING).revision == 8
    assert content(authority.model) != before
    check_forbidden(authority, carol.undo(8))


# -- anything ------------------------------------------------------------------------------------------------


def lie(request: protocol.EditRequest, random: Random, history: History) -> protocol.EditRequest:
    """Return a request that says another thing about an operation than it does."""
    field = random.choice(("replaced", "rerun", "moved", "removed"))
    said = [*getattr(request.changes, field)]
    if said and random.random() < 0.5:
        said.pop(random.randrange(len(said)))
    else:
        said.append(random.choice([*history.tags, *map(protocol.tag_of, request.changes.put)]))
    return with_changes(request, **{field: tuple(said)})


@pytest.mark.parametrize("seed", range(attempts(8)))
def test_no_edit_changes_an_operation_that_its_user_may_not_edit(seed: int) -> None:
    random, authority = Random(seed), Authority(Store(None))
    entries = edits.build().history.sequence

    def fill(edit: Edit) -> None:
        for entry in entries:
            edit.apply(entry.operation, entry.tag)

    def list_others(history: History) -> list[tuple[str, Any]]:
        """Return what the user may not edit, in order; what is run again is the same operation."""
        others = [one for one in history.sequence if find_forbidden(right, one.tag, one.writes)]
        return [(one.tag, getattr(one.operation, "given", None)) for one in others]

    def act(edit: Edit, tag: str) -> None:
        edits.do_something(edit, random, tag)

    authority.fill(fill, "me")
    right, replica = Right(("part/", "more/"), "carol"), Replica(authority)
    answers = set[tuple[bool, str]]()
    for count in range(60):
        try:
            request: Any = replica.draft(partial(act, tag=f"{count}"))
        except kv.KineverseError:  # refused by the client's own model
            continue
        if random.random() < 0.2:
            request = replica.undo(random.randint(1, authority.revision))
        is_limited = random.random() < 0.7
        if is_limited and isinstance(request, protocol.EditRequest) and random.random() < 0.3:
            request = lie(request, random, authority.model.history)
        before = list_others(authority.model.history)
        results = authority.process([request], [right if is_limited else EVERYTHING])
        replica.follow(results)
        answers.add((is_limited, getattr(results[0].answer, "reason", "")))
        assert not is_limited or list_others(authority.model.history) == before
    assert content(replica.model) == content(authority.model)
    assert {(True, ""), (True, "forbidden"), (False, "")} <= answers
