"""Commands and small programs, which show what works where something is missing."""

from __future__ import annotations

import re

from inventory.bounded import ROOT

_EXAMPLES = ROOT / "examples"

COMMANDS = f"""
info kitchen
info pr2 --json
info articulations
info {_EXAMPLES}/door.urdf --frames --constraints
fk kitchen kitchen/fridge_door_handle --set kitchen/fridge_door=30deg
reach pr2 pr2/r_gripper_tool_frame --pose 0.7 -0.3 0.9
reach fetch fetch/gripper_link --pose 0.7 0.2 0.9 --collisions
plan {_EXAMPLES}/arm.urdf --from j0=1 --to j0=-1 --move j0 j1 j2
plan shelf_door --to shelf_door/door=80deg
unlock lockboxes/thesis --goal lockbox/a=1.2
unlock lockboxes/thesis --goal lockbox/a=1.2 --json
open kitchens/0 --robot hsr --what kitchen/oven_door --json
close kitchens/0 --robot hsr --what kitchen/oven_door --json
push kitchens/0 --robot hsr --what kitchen/oven_door --json
open kitchens/0 --robot hsr --what kitchen/oven_door --world mujoco --json
push kitchens/0 --robot hsr --what kitchen/oven_door --record run.mcap
view articulations
view articulations/ratchet --picture ratchet.png
view nosuch --picture k.png
convert kitchen kitchen.kv.json
convert {_EXAMPLES}/door.urdf door.kv.msgpack
convert {_EXAMPLES}/door.urdf door.xml
convert {_EXAMPLES}/door.urdf copy.urdf
diff {_EXAMPLES}/door.urdf {_EXAMPLES}/door_new.urdf
diff {_EXAMPLES}/door.urdf {_EXAMPLES}/door_new.urdf --json
validate kitchen {_EXAMPLES}/door.urdf
validate {_EXAMPLES}/door.urdf --json
decompose {_EXAMPLES}/door.urdf
spheres shelf_door
fit {_EXAMPLES}/poses.csv --parent cupboard --child door
fit {_EXAMPLES}/poses.csv --parent cupboard --child door --picture fit.png
live --headless --what kitchen/sink_left_upper_drawer --json
bench --list
bench call --quick
reproduce --list
reproduce fig3
reproduce fig3 --quick
opne kitchen
info nosuch
info kitchen --nosuch
fk kitchen nosuch
""".strip().splitlines()

_PRELUDE = """
import numpy as np
import kineverse as kv
arm, fridge = "ARM", "kitchen/fridge_door"
kitchen = kv.load("kitchen")
door, start, handle = kitchen.symbol(fridge), kitchen.default_state(), kitchen.fk(fridge + "_handle")
""".replace("ARM", str(_EXAMPLES / "arm.urdf"))

_PROGRAMS = """
# import all names
for name in kv.__all__: getattr(kv, name)
# compile and wait
print(kv.compile(handle, wait=True)([0.3]))
# compile in C
print(kv.compile(handle, tier="c", wait=True)([0.3]))
# batch
print(kv.compile(handle).batch(np.zeros((2000, 1))).shape)
# controller
print(kv.control.Controller(kitchen, [kv.control.Goal(door, 1.0)], dt=0.02).step(start))
# controller with a scene
scene = kv.geometry.Scene(kitchen)
print(kv.control.Controller(kitchen, [kv.control.Goal(door, 1.0)], dt=0.02, scene=scene).step(start))
# inverse kinematics
print(kv.control.inverse_kinematics(kitchen, [kv.control.Hold(door, 0.5)]).solved)
# scene
scene = kv.geometry.Scene(kitchen)
scene.update(start)
print(len(scene.pairs_within(0.01)))
# tracker
tracker = kv.estimation.Tracker(kitchen, [fridge])
print(tracker.update({fridge: kitchen.fk(fridge)({door: 0.3})}).state[door])
# identify
poses = np.array([(kv.rotation_z(a) @ kv.translation(1, 0, 0))() for a in np.linspace(0, 1, 20)])
print(kv.estimation.identify(np.tile(np.eye(4), (20, 1, 1)), poses).best.family)
# planner
planner = kv.planning.Planner(kv.load(arm), ["j0", "j1", "j2"])
print(planner.plan({"j0": 1.0}, {"j0": -1.0}).found)
# skill
from kineverse.manipulation.session import Session
kitchen.include("hsr")
world = kv.worlds.KinematicWorld(kitchen, "hsr")
print(kv.manipulation.open_object(Session(world), "kitchen/oven_left_drawer", target=0.1))
# grasping
from kineverse.grasping import *
# plan of moves
print(kv.reasoning.plan_unlocking(kv.load("lockboxes/thesis"), {"lockbox/a": 1.2}).verdict)
# MJCF
body = '<body name="b"><joint name="j" axis="0 0 1"/><geom size=".1"/></body>'
open("m.xml", "w").write(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
print(kv.load("m.xml"))
# SDF
open("m.sdf", "w").write('<sdf version="1.9"><model name="m"><link name="a"/></model></sdf>')
print(kv.load("m.sdf"))
# xacro
text = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="${1 + 1}"/></robot>'
open("r.urdf.xacro", "w").write(text)
print(kv.load("r.urdf.xacro"))
# page
print(kv.show(kitchen, block=False, open_browser=False))
"""

PROGRAMS = {
    name: _PRELUDE + text for name, text in re.findall(r"^# (.+)\n((?:(?!# ).*\n)+)", _PROGRAMS, re.MULTILINE)
}
