"""Six processes share a model: a robot opens a door that everybody takes for a drawer.

The world knows the truth. A server keeps the model of all others: the state estimator tracks the door in it,
the model estimator notices that it is no drawer and edits the model, and the planner pushes by what it finds
there. Markers, states and commands go from process to process, beside the model. With ``--headless`` the
viewer writes the picture live.png, instead of a page. Extras: ``exchange``, ``control``, ``geometry``.
"""

import os
import sys
import time
from dataclasses import replace
from subprocess import PIPE, Popen

import numpy as np

import kineverse as kv
from kineverse import lie
from kineverse.control import Controller, Goal
from kineverse.model import Body, Box, Shape, Sphere

PERIOD = 0.05  # of camera, encoders and commands [s]
JOINTS = ["robot/x", "robot/y"]
SPEEDS = [f"{joint}:velocity" for joint in JOINTS]
MARKER = [f"marker/{i}" for i in range(6)]  # the pose of the door, as a twist
NOISE = np.repeat([0.003, 0.005], 3)  # standard deviations of a marker [m], [rad]


def add_scene(edit, joint):
    """Add a door on a joint, and a robot that is a finger."""
    edit.apply(joint)
    if joint.child != "door":
        edit.add_frame("door", joint.child, kv.translation(0, -0.3, 0))
    for name, parent, axis in (("robot/x", "world", (1, 0, 0)), ("robot/y", "robot/x", (0, 1, 0))):
        edit.apply(kv.Prismatic(name=name, parent=parent, child=name, axis=axis, velocity=0.3))
    for frame, shape in (("door", Shape(Box((0.02, 0.6, 0.6)))), ("robot/y", Shape(Sphere(0.02)))):
        edit.add_frame(f"{frame}/body", frame, body=Body((shape,), (shape,)))


def serve(name):
    """Serve a model with a drawer."""
    model, place = kv.Model(), {"origin": kv.translation(1, 0, 0), "axis": (-1, 0, 0)}
    with model.edit() as edit:
        add_scene(edit, kv.Prismatic(name="door", parent="world", child="door", lower=0, upper=0.5, **place))
    with kv.exchange.serve(model, name=name):
        print("ready", flush=True)
        sys.stdin.read()  # until the first process closes it, or ends


def simulate(name):
    """Move the robot and what it touches: a door in truth; send encoders and a marker, and take speeds."""
    truth, place = kv.Model(), {"origin": kv.translation(1, 0.3, 0), "axis": (0, 0, -1)}
    with truth.edit() as edit:
        add_scene(edit, kv.Revolute(name="door", parent="world", child="hinge", lower=0, upper=1.5, **place))
    world, random = kv.worlds.KinematicWorld(truth, "robot"), np.random.default_rng(0)
    world.reset({"door": 0.3, "robot/x": 0.97, "robot/y": 0})
    model = kv.load(f"live:{name}")
    sensors = model.exchange.publisher("robot", JOINTS + MARKER)
    commands, speeds = model.exchange.reader(SPEEDS), np.zeros(2)
    while world.state["door"] < 1.2 and world.time < 60 and model.exchange.is_online:
        pose = lie.retract(truth.fk("door")({"door": world.state["door"]}), random.normal(0, NOISE))
        sensors.put([*(world.state[joint] for joint in JOINTS), *lie.log_se3(pose)])
        if commands.into(speeds) < 2 or commands.age["planner"] > 0.2:
            speeds[:] = 0  # silence stops the robot
        world.apply(dict(zip(SPEEDS, speeds, strict=True)), PERIOD)
        time.sleep(PERIOD)
    print(f"the door is open by {world.state['door']:.1f} rad", flush=True)


def receive(model, names):
    """Yield the newest values of coordinates whenever one comes, until the server has ended."""
    reader, vector = model.exchange.reader(names), np.zeros(len(names))
    while model.exchange.is_online:
        if reader.wait(0.1) and reader.into(vector) == len(names):
            yield vector


def estimate_state(name):
    """Track the door by its marker in the present model."""
    model = kv.load(f"live:{name}")
    publisher = model.exchange.publisher("estimator", ["door"])
    tracker = kv.follow(model, lambda snapshot: kv.estimation.Tracker(snapshot, ["door"]), frames=["door"])
    for marker in receive(model, MARKER):
        estimate = tracker.value.update({"door": lie.exp_se3(marker)}, at=time.time())
        publisher.put([estimate.state["door"]])


def estimate_model(name):
    """Test the present model by the marker, and replace what does not explain it."""
    model, noise = kv.load(f"live:{name}"), {"noise": np.diag(NOISE**2), "decorrelation_time": 0}
    monitor = kv.estimation.PlausibilityMonitor(model, ["door"], outliers=False, **noise)
    for marker in receive(model, MARKER):
        monitor.update({"door": lie.exp_se3(marker)})
        if monitor.implausible_since and monitor.count % 10 == 0:
            for tag, joint in monitor.report().replacements.items():
                with model.edit() as edit:  # how far the joint goes is not known yet
                    edit.replace(tag, replace(joint, lower=None, upper=None))
                print(f"{tag} is {model.articulations['door'].kind}", flush=True)


def plan(name):
    """Push the door from inside, toward the robot, by the present model and state."""

    def make_controller(snapshot):
        tip, inside = snapshot.fk("robot/y"), snapshot.fk("door") @ kv.translation(0.03, 0, 0)
        touch, swing = Goal((tip - inside)[:2, 3], gain=5), Goal(inside[0, 3], 0.7, speed=0.2)
        return Controller(snapshot, [touch, swing], dt=PERIOD)

    model = kv.load(f"live:{name}", frames=["door", "robot/y"])  # a part is enough
    publisher = model.exchange.publisher("planner", SPEEDS)
    controller = kv.follow(model, make_controller, frames=["door"])
    for values in receive(model, [*JOINTS, "door"]):
        command = controller.value.step(dict(zip([*JOINTS, "door"], values, strict=True)))
        publisher.put([command.speeds[kv.velocity(joint)] for joint in JOINTS])


def view(name):
    """Show the present model and state."""
    model, state = kv.load(f"live:{name}"), {}
    page = None if "--headless" in sys.argv else kv.show(model, block=False)
    for values in receive(model, [*JOINTS, "door"]):
        state = dict(zip([*JOINTS, "door"], values, strict=True))
        if page:
            page.move(state)
    if page:
        page.wait()
    else:
        kv.view.save_picture("live.png", model, state)


def start(role, **streams):
    """Start the process of a role."""
    command = [sys.executable, __file__, role.__name__, f"door-{os.getpid()}", *sys.argv[1:]]
    return Popen(command, encoding="utf-8", **streams)


ROLES = (simulate, estimate_state, estimate_model, plan, view)
if __name__ == "__main__":
    if role := {role.__name__: role for role in (serve, *ROLES)}.get(" ".join(sys.argv[1:2])):
        role(sys.argv[2])
    else:
        with start(serve, stdin=PIPE, stdout=PIPE) as server:
            server.stdout.readline()
            processes = [start(role) for role in ROLES]
            processes[0].wait()
        for process in processes:  # they end without the server
            process.wait()
