"""Skills with a robot of which there is nothing but an interface: noisy readings come out, and speeds go in."""

from functools import cache

import pytest

import kineverse as kv
from kineverse.manipulation import Robot, Session, open_object, place_robot, push
from kineverse.worlds import KinematicWorld, Sensors

FRIDGE, DRAWER = "kitchen/fridge_door", "kitchen/sink_left_upper_drawer"
OPEN = {FRIDGE: 1.2, DRAWER: 0.4}
TOLERANCE = 0.03  # largest distance of the truth from a target, with the error of the estimate [m], [rad]


class Elsewhere:
    """A robot in another place: its model is a copy, and its truth is out of reach."""

    __slots__ = ("apply", "model", "name", "observe", "read_clock", "remarks", "robot", "timeout")

    def __init__(self, world):
        self.name, self.timeout, self.remarks = "elsewhere", 0.1, ()
        self.model = world.model.copy()
        self.robot = Robot.of(self.model, world.robot.name)
        self.apply, self.observe = world.apply, world.observe
        self.read_clock = lambda: world.time

    @property
    def time(self):
        return self.read_clock()


@cache
def kitchen(robot):
    """Return the kitchen with a robot, and the state in which it stands somewhere free."""
    model = kv.load("kitchen")
    placed = place_robot(model, robot)
    start, _ = placed.find_free_start(model, placed.start_state(model))
    return model, start


def connect(robot, **values):
    """Return a world, and a session that knows no more of it than its interface tells."""
    model, start = kitchen(robot)
    world = KinematicWorld(model, robot, sensors=Sensors.parse("3mm+3mm/m,0.5deg,30Hz"))
    world.reset(start.updated(values))
    return world, Session(Elsewhere(world))


@pytest.mark.long  # docs/manipulation.md has a robot of one's own that opens a drawer
@pytest.mark.parametrize("robot", ["hsr", "pr2", "fetch"])
@pytest.mark.parametrize("what", [FRIDGE, DRAWER])
def test_any_robot_opens_and_closes(robot, what):
    world, session = connect(robot)
    for target in (OPEN[what], 0.0):
        outcome = open_object(session, what, target=target)
        assert outcome, outcome.reason
        assert world.state[what] == pytest.approx(target, abs=TOLERANCE)
        assert outcome.value == pytest.approx(world.state[what], abs=0.01)
        assert outcome.world == "elsewhere"
        assert world.held is None


@pytest.mark.parametrize(
    "robot", ["hsr", *(pytest.param(one, marks=pytest.mark.long) for one in ("pr2", "fetch"))]
)
def test_any_robot_pushes_a_drawer_shut(robot):
    world, session = connect(robot, **{DRAWER: 0.4})
    outcome = push(session, DRAWER)
    assert outcome, outcome.reason
    assert world.state[DRAWER] == pytest.approx(0.0, abs=TOLERANCE)
