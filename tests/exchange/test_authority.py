"""The model of a server: what it accepts, merges and refuses, and that all who follow it have the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from faults.edits import Above, Capped, Count, Twice
from hypothesis import given, settings
from hypothesis import strategies as st
from replicas import Act, Exists, Replica, content

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse import gallery
from kineverse.exchange import authority as authorities
from kineverse.exchange import conflicts, protocol
from kineverse.exchange.authority import Authority, Result
from kineverse.exchange.protocol import Changes, Committed, Placed, Refused
from kineverse.exchange.store import Store, StoreError
from kineverse.model import Edit
from kineverse.model.basic_operations import SetData


def build(edit: Edit) -> None:
    """Make a model with each kind of dependence."""
    edit.write("a", 1.5, "a")
    edit.write("b", 2.5, "b")
    edit.write("c", 0.5, "c")
    edit.apply(Twice("twice", "a"), "twice")
    edit.apply(Capped("capped", "b"), "capped")
    edit.apply(Exists("exists", "a"), "exists")
    edit.add_frame("f", "world", kv.translation(kv.position("f"), 0, 0), tag="f")
    edit.add_frame("g", "f", kv.translation(0, 1, 0), tag="g")
    edit.apply(Above("w", "g"), "watch")
    edit.constrain("range", 0, kv.position("f"), 1, "range")


def started() -> tuple[Store, Authority]:
    store = Store(None)
    authority = Authority(store)
    authority.fill(build, "me")
    return store, authority


def ask(authority: Authority, *requests: Any) -> list[Any]:
    return [result.answer for result in authority.process(requests)]


def put(name: str, value: Any) -> Act:
    return lambda edit: edit.replace(name, SetData(name, value))


def accepted(answer: Any) -> bool:
    assert isinstance(answer, Committed | Refused)
    assert not isinstance(answer, Refused) or ("\n" not in answer.message and answer.message[-1] in ".?")
    return isinstance(answer, Committed)


# -- everybody has the same ----------------------------------------------------------------------------------

number = st.integers(0, 30)
action = st.tuples(st.sampled_from(range(12)), number, number)
turn = st.one_of(
    st.tuples(st.just("edit"), st.integers(0, 2), st.lists(action, min_size=1, max_size=3)),
    st.tuples(st.just("edit"), st.integers(0, 2), st.lists(action, min_size=1, max_size=1)),
    st.tuples(st.just("follow"), st.integers(0, 2), st.just(())),
    st.tuples(st.just("undo"), st.integers(0, 2), number),
    st.tuples(st.just("restart"), st.just(0), st.just(())),
)


def do(edit: Edit, kind: int, i: int, k: int, new: str) -> None:
    """Do one thing in an edit, if it can be done."""
    history = edit.model.history  # type: ignore[attr-defined]
    tags, frames = history.tags, ("world", *edit.model.frames)
    tag, other = (tags[n % len(tags)] if tags else "none" for n in (i, k))
    name, frame, parent = "abcd"[i % 4], frames[i % len(frames)], frames[k % len(frames)]
    steps: dict[int, Callable[[], object]] = {
        0: lambda: edit.write(name, k / 4, new),
        1: lambda: edit.replace(tag, SetData(name, k / 4)),
        2: lambda: edit.apply(Twice(f"twice {i % 3}", name), new),
        3: lambda: edit.apply(Capped(f"capped {i % 3}", name), new),
        4: lambda: edit.apply(Count(f"count {i % 3}"), new),
        5: lambda: edit.add_frame(f"f{i % 4}", parent, kv.translation(k, 0, kv.position("q")), tag=new),
        6: lambda: edit.attach(frame, parent, kv.translation(0, 0, k), new),
        7: lambda: edit.remove(tag),
        8: lambda: (edit.remove(tag), edit.insert(history.entries[tag].operation, tag, before=other)),
        9: lambda: edit.insert(SetData(name, k / 4), new, before=tag),
        10: lambda: edit.replace(tag, history.operation(tag)),
        11: lambda: edit.apply(Above(f"f{i % 4}", frame), new),
    }
    point = edit.savepoint()
    try:
        steps[kind]()
    except (kv.KineverseError, KeyError):
        point.roll_back()


@given(st.lists(turn, min_size=4, max_size=14))
@settings(max_examples=attempts(30), derandomize=True)
def test_replicas_store_and_log_have_the_model_of_the_server(turns: list[Any]) -> None:
    store, authority = started()
    first = Replica(authority)
    replicas = [Replica(authority, client) for client in "abc"]
    log: list[Result] = []
    for count, (kind, who, what) in enumerate(turns):
        replica = replicas[who]
        if kind == "restart":
            authority = Authority(store)
            continue
        if kind == "follow":
            replica.follow([one for one in log if _revision(one) > replica.revision])
            continue
        before = content(authority.model)
        if kind == "undo":
            request: Any = replica.undo(max(authority.revision - what % 5, 1))
        else:
            try:
                request = replica.draft(
                    lambda edit, what=what, count=count: [  # type: ignore[misc]
                        do(edit, *one, f"t{count}.{k}") for k, one in enumerate(what)
                    ]
                )
            except kv.KineverseError:
                continue  # refused by the client's own model
        (result,) = authority.process([request])
        if not accepted(result.answer):
            assert content(authority.model) == before
            assert result.commit is None
        elif result.commit is not None:
            log.append(result)
            assert authority.revision == result.answer.revision == _revision(result)
    replay = Replica(Authority(Store(None)))
    for data in reversed(store.last_commits(1000, authority.revision + 1)):
        replay.adopt(data)
    for replica in (first, *replicas):
        replica.follow([one for one in log if _revision(one) > replica.revision])
    again = Authority(store)
    for one in (replay, first, *replicas, again):
        assert content(one.model) == content(authority.model)
        assert one.model.snapshot() == authority.model.snapshot()
        assert one.chain == authority.chain == store.chain
        assert one.revision == authority.revision == store.revision


def _revision(result: Result) -> int:
    assert result.commit is not None
    return int(result.commit.message.revision)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", gallery.names())
def test_scenes_arrive_operation_by_operation(name: str) -> None:
    scene = kv.load(f"articulations/{name}")
    authority = Authority(Store(None))
    replica = Replica(authority)
    for tag in scene.history.tags:
        blob = kv.formats.operation_to_bytes(scene, tag)
        results = authority.process([replica.request(Changes((Placed(blob, at_end=True),)))])
        assert accepted(results[0].answer), results[0].answer
        replica.follow(results)
    assert content(authority.model) == content(replica.model) == content(scene)
    assert authority.model.snapshot() == scene.snapshot()


def test_dependents_are_run_again_without_their_code() -> None:
    _, authority = started()
    one, other = Replica(authority), Replica(authority, "b")
    results = authority.process([one.draft(put("a", 4.0)), other.draft(put("c", 2.5))])
    assert [accepted(result.answer) for result in results] == [True, True]
    changes = results[0].commit.message.changes  # type: ignore[union-attr]
    assert (changes.replaced, changes.rerun) == (("a",), ("twice",))
    one.follow(results)
    assert one.model.data["twice"] == authority.model.data["twice"] == 8.0


def test_a_loop_that_the_client_has_closed_is_not_closed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = kv.load("articulations/four_bar")
    authority = Authority(Store(None))
    authority.fill(lambda edit: [edit.apply(e.operation, e.tag) for e in scene.history.sequence], "me")
    one, other = Replica(authority), Replica(authority, "b")
    end = scene.frames["four_bar/coupler_end"].transform()
    longer = kv.model.Pose.from_matrix(end @ kv.translation(1e-3, 0, 0)())
    moved = kv.Fixed(name="e", parent="four_bar/coupler", child="four_bar/coupler_end", origin=longer)
    request = one.draft(lambda edit: edit.replace("four_bar/frame coupler_end", moved))
    assert request.changes.rerun == ("four_bar/loop four_bar",)
    closed = list[int]()
    apply = kv.CloseLoop.apply
    monkeypatch.setattr(kv.CloseLoop, "apply", lambda *given: closed.append(1) or apply(*given))
    late = other.request(request.changes)
    results = authority.process([request])
    assert accepted(results[0].answer), results[0].answer
    assert closed == []
    one.follow(results)
    before = one.model.snapshot()
    results += authority.process([one.undo(2), dataclass_like(late, client="c" * 32)])
    one.follow(results[1:])
    assert accepted(results[1].answer), results[1].answer
    assert results[2].answer.reason == "conflict"  # type: ignore[union-attr]
    assert content(one.model) == content(authority.model) == content(Authority(authority._store).model)
    assert before.frames["four_bar/coupler_end"] == kv.model.Frame("four_bar/coupler", (longer,))


def test_what_was_run_again_for_nothing_stays() -> None:
    _, authority = started()
    replica = Replica(authority)

    def act(edit: Edit) -> None:
        edit.insert(SetData("a", 9.0), "for a while", before="twice")
        assert edit.model.data["twice"] == 18.0
        edit.remove("for a while")
        edit.write("n", 1, "n")

    request = replica.draft(act)
    assert request.changes.rerun == ("twice",)
    results = authority.process([request])
    assert accepted(results[0].answer), results[0].answer
    replica.follow(results)
    assert content(replica.model) == content(authority.model)
    assert authority.model.data["twice"] == 3.0


# -- conflicts -----------------------------------------------------------------------------------------------


def fresh(name: str, parent: str = "world") -> Act:
    return lambda edit: edit.add_frame(name, parent, tag=f"frame {name}")


def both(*acts: Act) -> Act:
    return lambda edit: [act(edit) for act in acts]


def move_exists(edit: Edit) -> None:
    operation = edit.model.history.operation("exists")  # type: ignore[attr-defined]
    edit.remove("exists")
    edit.apply(operation, "exists")


PAIRS: dict[str, tuple[Act, Act, str]] = {
    # what was done first, what is asked at the revision before it, and the path or tag in conflict ("": none)
    "different data": (put("a", 2.0), put("c", 1.0), ""),
    "the same datum": (put("a", 2.0), put("a", 3.0), "a"),
    "one datum by two operations": (
        lambda edit: edit.write("n", 1, "one"),
        lambda edit: edit.write("n", 2, "two"),
        "data/n",
    ),
    "the same tag": (lambda edit: edit.write("n", 1, "new"), lambda edit: edit.write("m", 1, "new"), "new"),
    "the same frame": (
        lambda edit: edit.add_frame("n", "world", tag="one"),
        lambda edit: edit.add_frame("n", "f", tag="two"),
        "frames/n",
    ),
    "removed twice": (lambda edit: edit.remove("range"), lambda edit: edit.remove("range"), "range"),
    "replaced and removed": (put("c", 1.0), lambda edit: edit.remove("c"), "c"),
    "a value that is read": (put("a", 2.0), lambda edit: edit.apply(Twice("n", "a"), "n"), "data/a"),
    "a value that is looked for": (put("a", 2.0), lambda edit: edit.apply(Exists("n", "a"), "n"), ""),
    "a name that is looked for": (
        lambda edit: edit.write("n", 1, "n"),
        lambda edit: edit.apply(Exists("m", "n"), "m"),
        "data/n",
    ),
    "a value that was read": (lambda edit: edit.apply(Twice("n", "a"), "n"), put("a", 2.0), "data/a"),
    "a value that was looked for": (lambda edit: edit.apply(Exists("n", "a"), "n"), put("a", 2.0), ""),
    "a name that was looked for": (
        lambda edit: edit.apply(Exists("m", "n"), "m"),
        lambda edit: edit.write("n", 1, "n"),
        "data/n",
    ),
    "names that are listed": (fresh("n"), lambda edit: edit.apply(Count("n"), "n"), "frames"),
    "names that were listed": (lambda edit: edit.apply(Count("n"), "n"), fresh("n"), "frames/n"),
    "a frame below one that moves": (
        lambda edit: edit.attach("g", "world", kv.translation(0, 2, 0)),
        fresh("n", "g"),
        "",
    ),
    "a frame below one that is gone": (
        both(lambda edit: edit.remove("watch"), lambda edit: edit.remove("g")),
        fresh("n", "g"),
        "frames/g",
    ),
    "what a frame hangs on": (
        fresh("n", "g"),
        both(lambda edit: edit.remove("watch"), lambda edit: edit.remove("g")),
        "frames/g",
    ),
    "what a rerun has written": (
        put("a", 2.0),
        lambda edit: edit.apply(Capped("n", "twice"), "n"),
        "data/twice",
    ),
    "what reads the same": (put("a", 2.0), lambda edit: edit.remove("exists"), ""),
    "after one that is gone": (
        lambda edit: edit.remove("exists"),
        lambda edit: edit.insert(SetData("n", 1), "n", after="exists"),
        "operation 'exists'",
    ),
    "after one that has moved": (
        move_exists,
        lambda edit: edit.insert(SetData("n", 1), "n", after="exists"),
        "exists",
    ),
    "after the same": (
        lambda edit: edit.insert(SetData("n", 1), "n", after="exists"),
        lambda edit: edit.insert(SetData("m", 1), "m", after="exists"),
        "",
    ),
}


@pytest.mark.parametrize("name", PAIRS)
def test_conflicts(name: str) -> None:
    first, second, where = PAIRS[name]
    _, authority = started()
    one, other = Replica(authority), Replica(authority, "b")
    late = other.draft(second)
    results = authority.process([one.draft(first), late])
    assert accepted(results[0].answer), results[0].answer
    answer = results[1].answer
    if not where:
        assert accepted(answer), answer
        return
    assert not accepted(answer)
    assert isinstance(answer, Refused)
    assert answer.reason == "conflict"
    assert (answer.revision, answer.who) == (2, "client a")
    assert where in answer.message
    assert "client a" in answer.message
    other.follow(results)  # on what is there now, it is made or refused by the client's own model
    try:
        again = other.draft(second)
    except kv.KineverseError:
        return
    assert accepted(authority.process([again])[0].answer)


def test_cycles_of_two_edits_are_refused_by_the_fold() -> None:
    _, authority = started()
    Replica(authority)
    authority.process([Replica(authority).draft(both(fresh("x"), fresh("y")))])
    one, other = Replica(authority, "b"), Replica(authority, "c")
    late = other.draft(lambda edit: edit.attach("y", "x", kv.translation(0, 0, 0)))
    first = one.draft(lambda edit: edit.attach("x", "y", kv.translation(0, 0, 0)))
    before, after = ask(authority, first, late)
    assert accepted(before)
    assert not accepted(after)
    assert after.reason in ("refused", "conflict")


def test_a_strict_edit_is_refused_after_any_other() -> None:
    _, authority = started()
    one, other = Replica(authority), Replica(authority, "b")
    late = other.draft(put("c", 1.0), strict=True)
    first = one.draft(put("a", 2.0), strict=True)
    before, after = ask(authority, first, late)
    assert accepted(before)
    assert (after.reason, after.revision, after.who) == ("conflict", 2, "client a")


def test_a_base_that_is_not_known_is_stale_and_one_of_before_the_start_is_in_conflict() -> None:
    store, authority = started()
    replica = Replica(authority)
    early = replica.draft(put("a", 2.0))
    authority.process([Replica(authority, "b").draft(put("c", 1.0))])
    authority = Authority(store)
    wrong = dataclass_like(early, chain=b"x" * 32, number=7)
    ahead = dataclass_like(early, base=9, number=8)
    of_before, elsewhere, later = ask(authority, early, wrong, ahead)
    assert (of_before.reason, elsewhere.reason, later.reason) == ("conflict", "stale", "stale")
    assert "started again" in of_before.message


def test_what_is_long_ago_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    store, authority = started()
    replica, late = Replica(authority), Replica(authority, "b")
    early = late.draft(put("c", 2.0))
    monkeypatch.setattr(conflicts, "KEPT", 3)
    monkeypatch.setattr(authorities, "ANSWERS", 2)
    first = replica.draft(lambda edit: edit.write("n", 0, "0"))
    for number in range(4):
        request = (
            first if not number else replica.draft(lambda edit, tag=str(number): edit.write(tag, 0, tag))
        )
        results = authority.process([request])
        replica.follow(results)
    (stale,) = ask(authority, early)
    assert stale.reason == "stale"
    assert ask(authority, first) == [Committed(2, store.commits_after(1, late.chain, 10)[0][1])]  # type: ignore[index]
    assert authority.revision == 5


def dataclass_like(message: Any, **changes: Any) -> Any:
    return msgspec.structs.replace(message, **changes)


# -- answers -------------------------------------------------------------------------------------------------


def test_an_edit_that_is_asked_twice_is_made_once_and_answered_alike() -> None:
    store, authority = started()
    replica = Replica(authority)
    request = replica.draft(lambda edit: edit.write("n", 1, "n"))
    refused = dataclass_like(request, number=9, base=5)
    results = authority.process([request, refused, request, refused])
    assert [result.commit is not None for result in results] == [True, False, False, False]
    assert results[0].answer == results[2].answer == authority.process([request])[0].answer
    assert results[1].answer == results[3].answer
    assert ask(Authority(store), request) == [results[0].answer]
    assert store.revision == 2


def test_an_edit_without_effect_is_no_commit() -> None:
    store, authority = started()
    results = authority.process([Replica(authority).draft(lambda edit: None)])
    assert results == [Result(Committed(1, authority.chain), seconds=results[0].seconds)]
    assert (store.revision, authority.revision) == (1, 1)


class FailingStore(Store):
    """Store whose disk is full for a while."""

    is_full = False

    def commit(self, batch: Any) -> None:
        if self.is_full:
            raise StoreError("The disk is full.")
        super().commit(batch)


def test_after_an_error_of_the_store_nothing_has_happened() -> None:
    store = FailingStore(None)
    authority = Authority(store)
    authority.fill(build, "me")
    replica, before, epoch = Replica(authority), content(authority.model), authority.epoch
    done = replica.draft(put("c", 0.5))
    replica.follow(authority.process([done]))
    before = content(authority.model)
    store.is_full = True
    one, other = replica.draft(put("a", 2.0)), replica.draft(lambda edit: edit.write("n", 1, "n"))
    answers = ask(authority, one, other, one, done)
    assert [answer.reason for answer in answers[:3]] == ["failed"] * 3
    assert answers[3] == Committed(2, authority.chain)
    assert "disk is full" in answers[0].message
    assert authority.epoch != epoch
    assert (content(authority.model), authority.chain, authority.revision) == (before, store.chain, 2)
    store.is_full = False
    results = authority.process([one])
    assert accepted(results[0].answer)
    replica.follow(results)
    assert content(replica.model) == content(authority.model) == content(Authority(store).model)


def test_each_commit_comes_with_its_message_and_its_diff() -> None:
    _, authority = started()
    replica = Replica(authority)
    results = authority.process([replica.draft(put("a", 2.0)), replica.draft(put("c", 1.0))])
    commits = [result.commit for result in results if result.commit is not None]
    assert [(one.message.revision, one.diff.version, one.diff.replaced) for one in commits] == [
        (2, 2, ("a",)),
        (3, 3, ("c",)),
    ]
    assert [protocol.decode_commit(one.published.commit) for one in commits] == [
        one.message for one in commits
    ]


# -- undo ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_restarted", [False, True])
def test_undo_by_model_and_by_store(is_restarted: bool) -> None:
    store, authority = started()
    replica, other = Replica(authority), Replica(authority, "b")

    def make(act: Act) -> None:
        results = authority.process([replica.draft(act)])
        assert accepted(results[0].answer), results[0].answer
        replica.follow(results)

    first = content(authority.model)
    make(both(put("a", 3.0), lambda edit: edit.remove("exists"), lambda edit: edit.write("n", 1, "n")))
    make(lambda edit: (edit.remove("range"), edit.insert(SetData("m", 1), "m", after="a")))
    make(lambda edit: edit.remove("capped"))
    make(lambda edit: edit.replace("b", SetData("b", 9.5)))
    if is_restarted:
        authority = Authority(store)
    frozen = replica.undo(4)  # what it was made from has changed
    answers = ask(authority, frozen, replica.undo(77))
    assert [answer.reason for answer in answers] == ["conflict" if is_restarted else "refused", "unknown"]
    assert answers[0].tag == "capped"
    assert "data/b" in answers[0].message
    for revision in (5, 4, 3, 2):
        results = authority.process([replica.undo(revision)])
        assert accepted(results[0].answer), results[0].answer
        replica.follow(results)
    assert content(authority.model) == content(replica.model) == first
    (again,) = ask(authority, replica.undo(2))
    assert again.reason == "conflict"
    assert again.revision == 9
    assert other.model.snapshot() == authority.model.snapshot()


def test_what_was_removed_before_a_restart_goes_back_to_its_place() -> None:
    store, authority = started()
    before = authority.model.history.tags
    for client, tag in ("a", "exists"), ("b", "capped"):
        replica = Replica(authority, client)
        (result,) = authority.process([replica.draft(lambda edit, tag=tag: edit.remove(tag))])  # type: ignore[misc]
        assert accepted(result.answer)
    authority = Authority(store)
    assert accepted(ask(authority, Replica(authority, "c").undo(2))[0])  # what it followed is gone
    assert authority.model.history.tags == [tag for tag in before if tag != "capped"]


# -- lies ----------------------------------------------------------------------------------------------------


def changed(
    request: protocol.EditRequest, change: Callable[[dict[str, Any]], object], which: int = 0
) -> protocol.EditRequest:
    """Return a request with another content of a blob."""
    operations = list(request.changes.put)
    value = msgspec.msgpack.decode(operations[which].blob)
    change(value)
    operations[which] = dataclass_like(operations[which], blob=msgspec.msgpack.encode(value))
    return with_changes(request, put=tuple(operations))


def with_changes(request: protocol.EditRequest, **changes: Any) -> protocol.EditRequest:
    return dataclass_like(request, changes=dataclass_like(request.changes, **changes))  # type: ignore[no-any-return]


def lie_about_writes(replica: Replica) -> protocol.EditRequest:
    request = replica.draft(lambda edit: edit.apply(Twice("n", "a"), "n"))
    return changed(request, lambda value: value["writes"]["data"].update(n=77.0))


def test_a_trace_counts_more_than_the_writes_and_the_reads() -> None:
    _, authority = started()
    replica = Replica(authority)
    results = authority.process([lie_about_writes(replica)])
    assert accepted(results[0].answer)
    assert authority.model.data["n"] == 3.0
    replica.follow(results)
    request = replica.draft(lambda edit: edit.apply(Twice("m", "a"), "m"))
    results = authority.process([changed(request, lambda value: value.pop("reads"))])
    assert accepted(results[0].answer)
    replica.follow(results)
    assert content(replica.model) == content(authority.model)
    authority.process([replica.draft(put("a", 5.0))])
    assert (authority.model.data["m"], authority.model.data["n"]) == (10.0, 10.0)


def frozen_without_reads(replica: Replica) -> protocol.EditRequest:
    request = replica.draft(lambda edit: edit.apply(Capped("n", "b"), "n"))
    return changed(request, lambda value: value.pop("reads"))


def twice(replica: Replica) -> protocol.EditRequest:
    request = replica.draft(lambda edit: edit.write("n", 1, "n"))
    return with_changes(request, put=request.changes.put * 2)


def lone(
    replica: Replica, act: Act = lambda edit: edit.write("n", 1, "n"), **changes: Any
) -> protocol.EditRequest:
    return with_changes(replica.draft(act), **changes)


LIES: dict[str, tuple[Callable[[Replica], protocol.EditRequest], str]] = {
    "a frozen operation without reads": (frozen_without_reads, "malformed"),
    "a tag twice": (twice, "refused"),
    "no blob": (lambda replica: lone(replica, put=(Placed(b"\xc1", "", True),)), "malformed"),
    "an empty blob": (lambda replica: lone(replica, put=(Placed(b"", "", True),)), "malformed"),
    "a run again of one that is not there": (lambda replica: lone(replica, rerun=("n",)), "refused"),
    "a run again of one that depends on nothing": (
        lambda replica: lone(replica, put("c", 2.0), replaced=(), rerun=("c",)),
        "refused",
    ),
    "a run again that is not put": (lambda replica: lone(replica, rerun=("twice",)), "refused"),
    "a replacement that is not there": (lambda replica: lone(replica, replaced=("n",)), "refused"),
    "a new one that is there": (lambda replica: lone(replica, put("a", 2.0), replaced=()), "refused"),
    "a move that is none": (lambda replica: lone(replica, moved=("a",)), "refused"),
    "a removal of what is not there": (lambda replica: lone(replica, removed=("z",)), "refused"),
    "a removal twice": (lambda replica: lone(replica, removed=("range", "range")), "refused"),
    "put and removed": (
        lambda replica: lone(replica, put("c", 2.0), removed=("c",)),
        "refused",
    ),
    "an anchor that never was": (
        lambda replica: lone(
            replica, put=tuple(dataclass_like(one, after="z", at_end=False) for one in _put(replica))
        ),
        "refused",
    ),
    "a parent that is not there": (
        lambda replica: changed(
            replica.draft(fresh("n", "g")),
            lambda value: value["writes"]["frames"]["n"].update(parent="z"),
        ),
        "refused",
    ),
    "a frame below itself": (
        lambda replica: changed(
            replica.draft(fresh("n", "g")),
            lambda value: value["writes"]["frames"]["n"].update(parent="n"),
        ),
        "refused",
    ),
    "the world": (
        lambda replica: changed(
            replica.draft(fresh("n")),
            lambda value: value.update(writes={"frames": {"world": {"parent": "f", "factors": []}}}),
        ),
        "any",
    ),
    "no number": (
        lambda replica: changed(
            replica.draft(lambda edit: edit.write("n", 1.5, "n")),
            lambda value: value["writes"]["data"].update(n=float("nan")),
        ),
        "malformed",
    ),
    "a tag that is too long": (
        lambda replica: replica.draft(lambda edit: edit.write("n", 1, "n" * 5000)),
        "malformed",
    ),
    "nested too deeply": (
        lambda replica: changed(
            replica.draft(lambda edit: edit.write("n", 1.5, "n")),
            lambda value: value["writes"]["data"].update(n=_nested(500)),
        ),
        "malformed",
    ),
    "a constraint that is there": (
        lambda replica: changed(
            replica.draft(lambda edit: edit.constrain("n", 0, kv.position("f"), 2, "n")),
            lambda value: (
                value.pop("parameters"),
                value.update(writes={"constraints": {"range": value["writes"]["constraints"]["n"]}}),
            ),
        ),
        "refused",
    ),
}


def _put(replica: Replica) -> tuple[Placed, ...]:
    return replica.draft(lambda edit: edit.write("n", 1, "n")).changes.put


def _nested(depth: int) -> Any:
    value: Any = 1.0
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize("name", LIES)
def test_lies_are_refused_and_change_nothing(name: str) -> None:
    lie, reason = LIES[name]
    store, authority = started()
    replica = Replica(authority)
    before = content(authority.model), store.chain
    late = Replica(authority, "b")
    (answer,) = ask(authority, lie(replica))
    assert not accepted(answer)
    assert reason in (answer.reason, "any")
    assert (content(authority.model), store.chain) == before
    assert authority.model.snapshot() == late.model.snapshot()
    (good,) = ask(authority, late.draft(put("a", 2.0)))
    assert accepted(good)


@given(st.data())
@settings(max_examples=attempts(60), derandomize=True)
def test_damaged_edits_end_in_an_answer(data: Any) -> None:
    store, authority = DAMAGED
    replica = Replica(authority)
    request = replica.draft(both(put("a", 2.0), lambda edit: edit.apply(Above("x", "g"), "x")))
    message = bytearray(protocol.encode(request))
    for _ in range(data.draw(st.integers(1, 4))):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    try:
        decoded: Any = protocol.decode_request(bytes(message))
    except kv.errors.FormatError:
        return
    if isinstance(decoded, protocol.EditRequest):
        accepted(ask(authority, decoded)[0])
        assert content(Authority(store).model) == content(authority.model)


DAMAGED = started()
