"""What nodes take of messages that come in, and what they say about the others."""

from __future__ import annotations

import math

import pytest
from fake_rclpy import FakeRos, Time

from kineverse_ros.inputs import SECOND, Complaints, JointStateFilter, Topics
from kineverse_ros.names import NameMap

NOW = 1000 * SECOND


class Listener:
    """A filter of the joints ``arm/a``, ``arm/b``, ``arm/m``, of which the last is no free coordinate."""

    def __init__(self) -> None:
        self.said: list[str] = []
        names = NameMap(["arm/a", "arm/b", "arm/m"], {"arm/": ""})
        self.filter = JointStateFilter(names, ["arm/a", "arm/b"], Complaints(self.said.append))

    def hear(self, names, positions, velocities=(), *, at=0.0, stamp=None, source="/joint_states of /driver"):
        now = NOW + round(at * SECOND)
        stamp = now if stamp is None else NOW + round(stamp * SECOND)
        return self.filter.accept(source, stamp, names, positions, velocities, now)


def test_joint_states_are_readings_by_names_of_the_model():
    listener = Listener()
    readings = listener.hear(["b", "m", "a"], [2.0, 9.0, 1.0], [0.2, 0.9, math.nan])
    assert readings.positions == {"arm/b": 2.0, "arm/a": 1.0}
    assert readings.velocities == {"arm/b": 0.2}
    assert readings.stamp == NOW
    assert listener.said == []


@pytest.mark.parametrize(
    ("names", "positions", "velocities", "stamp", "expected", "complaint"),
    [
        (["a", "b"], [math.nan, 1.0], (), 0.0, {"arm/b": 1.0}, "no numbers: a"),
        (["a", "b"], [math.inf, 1.0], (), 0.0, {"arm/b": 1.0}, "no numbers: a"),
        (["a", "x"], [1.0, 1.0], (), 0.0, {"arm/a": 1.0}, "no joints of the model: x"),
        (["a", "b", "a"], [1.0, 2.0, 1.0], (), 0.0, {"arm/b": 2.0}, "twice in one message: a"),
        (["a", "b"], [1.0], (), 0.0, None, "2 names, 1 positions and 0 velocities"),
        (["a", "b"], [1.0, 2.0], [0.1], 0.0, None, "2 names, 2 positions and 1 velocities"),
        (["a"], [], (), 0.0, None, None),
        ([], [], (), 0.0, None, None),
        (["a"], [1.0], (), 0.6, None, "0.6 s ahead"),
        (["a"], [1.0], (), -1.1, None, "1.1 s old"),
        (["a"], [1.0], (), -1000.0, None, "has no stamp"),
    ],
)
def test_bad_joint_states_are_named_and_never_forwarded(
    names, positions, velocities, stamp, expected, complaint
):
    listener = Listener()
    readings = listener.hear(names, positions, velocities, stamp=stamp)
    assert (readings.positions if readings else None) == expected
    assert len(listener.said) == (complaint is not None)
    assert complaint is None or complaint in listener.said[0]


def test_stamps_that_go_back_are_refused_for_each_source_alone():
    listener = Listener()
    assert listener.hear(["a"], [1.0])
    assert not listener.hear(["a"], [2.0], at=0.1, stamp=-0.1)
    assert "0.1 s before the one that came before it" in listener.said[0]
    assert listener.hear(["b"], [2.0], at=0.1, stamp=-0.1, source="/other")
    assert listener.hear(["a"], [2.0], at=0.1, stamp=0.0)  # the same again


def test_a_clock_that_is_set_back_begins_anew():
    listener = Listener()
    assert listener.hear(["a"], [1.0])
    assert listener.hear(["a"], [2.0], at=-500.0)
    assert listener.said == ["The clock was set back by 500 s."]
    assert listener.hear(["a"], [2.0], at=-499.9)


def test_the_first_of_two_sources_has_a_joint_until_it_is_silent():
    listener = Listener()
    assert listener.hear(["a"], [1.0])
    assert listener.hear(["a", "b"], [5.0, 2.0], at=0.5, source="/other").positions == {"arm/b": 2.0}
    assert "'a' comes from two sources: /joint_states of /driver was first" in listener.said[0]
    assert listener.hear(["a"], [5.0], at=1.0, source="/other").positions == {"arm/a": 5.0}
    assert not listener.hear(["a"], [1.0], at=1.1)


def test_a_source_of_nothing_that_is_used_has_no_joint():
    listener = Listener()
    listener.hear(["a", "b", "b"], [math.nan, 1.0, 1.0], source="/broken")
    assert listener.hear(["a", "b"], [1.0, 2.0]).positions == {"arm/a": 1.0, "arm/b": 2.0}


def test_a_kind_of_complaint_is_said_once_a_second():
    listener = Listener()
    for step in range(250):
        listener.hear(["a", "unknown"], [math.nan, 0.0], at=step / 100)
    assert len([text for text in listener.said if "no numbers" in text]) == 3
    assert len([text for text in listener.said if "unknown" in text]) == 1


def test_topics_tell_sources_apart_and_name_what_nobody_serves():
    ros = FakeRos()
    node, driver = ros.rclpy.create_node("listener"), ros.rclpy.create_node("driver")
    heard, said = [], []
    topics = Topics(node, Complaints(said.append), lambda: ros.nanoseconds)
    topics.subscribe(ros.JointState, "joint_states", lambda m, source: heard.append(source), ros.QUEUED)
    topics.subscribe(ros.PoseStamped, "door", lambda m, source: heard.append(source), ros.QUEUED)
    topics.subscribe(ros.PoseStamped, "nobody", lambda m, source: heard.append(source), ros.QUEUED)
    for _ in range(2):
        driver.create_publisher(ros.JointState, "joint_states", ros.QUEUED).publish(ros.JointState())
    driver.create_publisher(ros.String, "door", ros.QUEUED).publish(ros.String())
    ros.advance(10)
    assert heard == ["/joint_states of /driver", "/joint_states of /driver #2"]
    assert sorted(said) == [
        "/door has geometry_msgs/msg/PoseStamped here, and messages of another type by /driver (std_msgs/msg/String).",
        "Nobody publishes /nobody (geometry_msgs/msg/PoseStamped).",
    ]
    assert ros.Time() == Time()


def test_messages_that_are_lost_are_counted_and_named():
    ros = FakeRos()
    node, driver = ros.rclpy.create_node("listener"), ros.rclpy.create_node("driver")
    said = []
    topics = Topics(node, Complaints(said.append), lambda: ros.nanoseconds)
    publisher = driver.create_publisher(ros.String, "words", ros.QUEUED)
    publisher.publish(ros.String())  # before there is a subscription
    topics.subscribe(ros.String, "words", lambda message, source: None, ros.QUEUED)
    for number in range(10):
        publisher.publish(ros.String())
        if number in (4, 5):
            ros.topic("words").subscriptions[0].queue.clear()
        ros.advance(0.01)
    assert topics.received == {"/words of /driver": 8}
    assert topics.lost == {"/words of /driver": 2}
    assert said == ["Messages of /words of /driver were lost, 2 so far."]
