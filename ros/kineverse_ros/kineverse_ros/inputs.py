"""Messages that come in: who sends them, which readings are taken, and complaints about the others."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

from kineverse.errors import list_some

from .names import NameMap

SECOND = 1_000_000_000  # [ns]; times are integers, since a double of today's seconds has steps of 200 ns

MOST_AHEAD, MOST_BEHIND = SECOND // 2, SECOND
"""Largest distances of a stamp from the present of the clock, ahead and behind."""

_SILENCE = SECOND  # after which another source may have a joint
PATIENCE = 3
"""Seconds until what nobody serves is named."""

_UNKNOWN = "_NODE_NAME_UNKNOWN_"  # ROS has this name until it knows a node


class Complaints:
    """Sentences about bad input, each kind at most once a second.

    Parameters
    ----------
    say
        Function that is given the sentences.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._next: dict[str, float] = {}

    def add(self, kind: str, text: str, now: int) -> bool:
        """Say a text unless one of its kind was said less than a second ago [ns]; return True if it was."""
        after = self._next.get(kind)
        # Where the clock was set back, a time that is far ahead is one from before.
        is_said = after is None or now >= after or now < after - SECOND
        if is_said:
            self._next[kind] = now + SECOND
            self._say(text)
        return is_said

    def add_once(self, text: str) -> None:
        """Say a text unless it was said before."""
        if text not in self._next:
            self._next[text] = math.inf
            self._say(text)


class Readings(NamedTuple):
    """Values that a message had, by names of the model; the stamp is in nanoseconds."""

    stamp: int
    positions: dict[str, float]
    velocities: dict[str, float]


class StampCheck:
    """Check of the times of messages: near the present, and in order for each source."""

    def __init__(self, complaints: Complaints) -> None:
        self._complaints = complaints
        self._last: dict[str, int] = {}
        self._now: int | None = None

    def follow_clock(self, now: int) -> bool:
        """Take over the present [ns]; return True, and forget old stamps, if the clock was set back."""
        was_set_back = self._now is not None and now < self._now
        if self._now is not None and was_set_back:
            behind = (self._now - now) / SECOND
            self._complaints.add("clock", f"The clock was set back by {behind:.3g} s.", now)
            self._last = {}
        self._now = now
        return was_set_back

    def accepts(self, source: str, stamp: int, now: int) -> bool:
        """Return True if a message can be taken; otherwise say why not."""
        age = (now - stamp) / SECOND
        before = self._last.get(source)
        if stamp == 0:
            text = "has no stamp; with 'ros2 topic pub', 'header: auto' gives it one"
        elif age < -MOST_AHEAD / SECOND:
            text = f"is {-age:.3g} s ahead of the clock"
        elif age > MOST_BEHIND / SECOND:
            text = f"is {age:.3g} s old"
        elif before is not None and stamp < before:
            text = f"is {(before - stamp) / SECOND:.3g} s before the one that came before it"
        else:
            self._last[source] = stamp
            return True
        self._complaints.add(f"stamp {source}", f"A message of {source} is not used: it {text}.", now)
        return False


class JointStateFilter:
    """Filter of joint states: what can be trusted of each message, by names of the model.

    Names that the model does not have are said once, and passed over. Anything else that is wrong is said at
    most once a second, and never forwarded. If several sources have a joint, the first one has it until it
    is silent for a second.

    Parameters
    ----------
    names
        All joints of the model.
    wanted
        Those of them that are read, names of free coordinates; others depend on these.
    """

    def __init__(self, names: NameMap, wanted: Collection[str], complaints: Complaints) -> None:
        self.follow(names, wanted)
        self._complaints = complaints
        self._stamps = StampCheck(complaints)
        self._unknown: set[str] = set()  # names that were said to be no joints
        self._owners: dict[str, tuple[str, int]] = {}  # source of a joint, and when it was last heard

    def follow(self, names: NameMap, wanted: Collection[str]) -> None:
        """Take over the joints of an edited model."""
        self._names, self._wanted = names, frozenset(wanted)

    def accept(
        self,
        source: str,
        stamp: int,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float],
        now: int,
    ) -> Readings | None:
        """Return what can be used of a message of a source; None for nothing. Times are in nanoseconds."""
        if self._stamps.follow_clock(now):
            self._owners = {}
        if not self._has_form(source, names, positions, velocities, now):
            return None
        if not self._stamps.accepts(source, stamp, now):
            return None
        found: dict[str, float] = {}
        speeds: dict[str, float] = {}
        bad: list[str] = []
        unknown: list[str] = []
        counts = Counter(names)
        for index, name in enumerate(names):
            joint = self._names.to_model(name)
            if joint is None:
                if name not in self._unknown:
                    unknown.append(name)
            elif joint not in self._wanted or counts[name] > 1:
                continue
            elif not math.isfinite(positions[index]):
                bad.append(name)
            elif self._is_from(source, joint, now):
                found[joint] = positions[index]
                # Controllers without a measurement of speeds send NaN.
                if len(velocities) and math.isfinite(velocities[index]):
                    speeds[joint] = velocities[index]
        if len(counts) < len(names):
            doubled = [name for name, count in counts.items() if count > 1]
            text = f"{source} has joints twice in one message: {list_some(doubled, 4)}. They are not used."
            self._complaints.add(f"doubled {source}", text, now)
        if unknown:
            text = f"{source} has names that are no joints of the model: {list_some(unknown, 4)}."
            if self._complaints.add(f"unknown {source}", text, now):
                self._unknown.update(unknown)
        if bad:
            text = f"{source} has positions that are no numbers: {list_some(bad, 4)}. They are not used."
            self._complaints.add(f"values {source}", text, now)
        return Readings(stamp, found, speeds) if found else None

    def _has_form(
        self,
        source: str,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float],
        now: int,
    ) -> bool:
        """Return True for a message with a position, and a speed or none, for each name."""
        if not len(positions):
            return False  # one of efforts alone
        if len(positions) == len(names) and len(velocities) in (0, len(names)):
            return True
        text = (
            f"A message of {source} is not used: it has {len(names)} names, {len(positions)} positions and "
            f"{len(velocities)} velocities."
        )
        self._complaints.add(f"form {source}", text, now)
        return False

    def _is_from(self, source: str, joint: str, now: int) -> bool:
        owner, heard = self._owners.get(joint, (source, now))
        if owner != source and now - heard < _SILENCE:
            text = (
                f"'{self._names.to_ros(joint)}' comes from two sources: {owner} was first, and {source} is "
                "not heard."
            )
            self._complaints.add(f"owner {source}", text, now)
            return False
        self._owners[joint] = source, now
        return True


class Topics:
    """Subscriptions of a node, whose callbacks are told the source of each message.

    A source is a node and its topic, as in ``/joint_states of /driver``. A topic that nobody serves, one that
    is served with messages of another type, and messages that were lost are said.

    Parameters
    ----------
    node
        Node of rclpy.
    now
        Function that returns the time [ns].
    clock
        Clock of rclpy that goes on where the time stands still, as it does without a simulator.

    Attributes
    ----------
    received, lost
        Number of messages by source; ROS before kilted does not tell what was lost.
    """

    def __init__(self, node: Any, complaints: Complaints, now: Callable[[], int], clock: Any = None) -> None:
        self._node, self._complaints, self._now = node, complaints, now
        self._wanted: dict[str, tuple[str, int]] = {}  # type of the messages, and how long they are awaited
        self.received, self.lost = Counter[str](), Counter[str]()
        self._sources: dict[tuple[str, bytes], str] = {}
        self._numbers: dict[str, int] = {}  # of the last message of each source
        self._subscriptions: list[tuple[Any, Any, Callable[[Any, Any], None]]] = []
        node.create_timer(1.0, self.check, clock=clock)

    def subscribe(self, kind: Any, topic: str, callback: Callable[[Any, str], object], quality: Any) -> None:
        """Have a function called with each message of a topic, and its source."""

        def receive(message: Any, info: Any) -> None:
            source = self._source(topic, info)
            self._count(source, info)
            callback(message, source)

        subscription = self._node.create_subscription(kind, topic, receive, quality)
        self._subscriptions.append((subscription, kind, receive))
        package = kind.__module__.partition(".")[0]
        self._wanted[topic] = f"{package}/msg/{kind.__name__}", 0

    def drain(self) -> None:
        """Take all messages that have come, without an executor."""
        for subscription, kind, receive in self._subscriptions:
            with subscription.handle:
                while (taken := subscription.handle.take_message(kind, False)) is not None:
                    receive(*taken)

    def check(self) -> None:
        """Say which topics nobody serves, or with messages of another type; called each second."""
        if self._now() == 0:
            self._complaints.add_once("The time is 0: use_sim_time is set, and nobody serves /clock.")
        for topic, (kind, waited) in self._wanted.items():
            publishers = self._node.get_publishers_info_by_topic(topic)
            others = [f"{_name(one)} ({one.topic_type})" for one in publishers if one.topic_type != kind]
            waited = 0 if len(publishers) > len(others) else waited + 1
            self._wanted[topic] = kind, waited
            name = self._node.resolve_topic_name(topic)
            if others:
                text = f"{name} has {kind} here, and messages of another type by {list_some(others, 3)}."
                self._complaints.add_once(text)
            elif waited >= PATIENCE:
                self._complaints.add_once(f"Nobody publishes {name} ({kind}).")

    def _count(self, source: str, info: Any) -> None:
        self.received[source] += 1
        number = info.get("publication_sequence_number")
        if number is None or "publisher_gid" not in info:  # it counts for each publisher
            return
        lost = number - self._numbers.get(source, number - 1) - 1
        self._numbers[source] = number
        if lost > 0:
            self.lost[source] += lost
            text = f"Messages of {source} were lost, {self.lost[source]} so far."
            self._complaints.add(f"lost {source}", text, self._now())

    def _source(self, topic: str, info: Any) -> str:
        """Return a name of the publisher of a message, another one for each."""
        try:
            gid = bytes(info["publisher_gid"]["data"])
        except (KeyError, TypeError):  # releases before kilted do not tell
            gid = b""
        if (topic, gid) not in self._sources:
            name = self._node.resolve_topic_name(topic)
            for publisher in self._node.get_publishers_info_by_topic(topic) if gid else ():
                if bytes(publisher.endpoint_gid)[: len(gid)] == gid:
                    name = f"{name} of {_name(publisher)}"
            count = sum(source.partition(" #")[0] == name for source in self._sources.values())
            self._sources[topic, gid] = f"{name} #{count + 1}" if count else name
        return self._sources[topic, gid]


def _name(info: Any) -> str:
    if info.node_name == _UNKNOWN:
        return "an unknown node"
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"
