"""Reach onto a table with a G1 without touching it; mink's ``humanoid_g1_teleop.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, same_orientation, same_pose
from kineverse.geometry import Rule, Scene
from kineverse.model import Body, Box, Shape, Sphere

model = kv.load("g1_description/urdf/g1_29dof_rev_1_0.urdf")
with model.edit() as edit:
    edit.apply(kv.Floating(name="root_joint", parent="world", child="free"))
    edit.attach("pelvis", "free", kv.translation(0, 0, 0))
    table = Body(collisions=(Shape(Box((0.5, 1.0, 0.04))),))
    edit.add_frame("table", "world", kv.translation(0.45, 0, 0.72), body=table)
    for side in ("left", "right"):
        palm, thigh = (Body(collisions=(Shape(Sphere(radius)),)) for radius in (0.06, 0.09))
        edit.add_frame(f"{side}_palm", f"{side}_rubber_hand", kv.translation(0.06, 0, 0), body=palm)
        edit.add_frame(f"{side}_thigh", f"{side}_hip_yaw_link", kv.translation(0, 0, -0.08), body=thigh)
bent = {"hip_pitch": -0.3, "knee": 0.6, "ankle_pitch": -0.3, "shoulder_pitch": 0.2, "elbow": 0.6}
start = model.default_state() | {"root_joint/z": 0.76}
start |= {f"{side}_{joint}_joint": angle for side in ("left", "right") for joint, angle in bent.items()}
time = kv.parameter("time", 0.0)

lean = (1 - np.cos(time)) * np.array([0.12, 0, -0.12])
centre = model.center_of_mass()
tasks = [Goal(centre, centre(start), name="centre of mass", gain=200, weight=4)]
for name in ("pelvis", "torso_link"):
    body = model.fk(name)
    tasks.append(Goal(same_orientation(body(start), body), name=name, gain=200, weight=0.04))
pairs = [Rule("*", "*")]
for side in ("left", "right"):
    foot, hand = model.fk(f"{side}_ankle_roll_link"), model.fk(f"{side}_rubber_hand")
    tasks.append(Hold(same_pose(foot(start), foot), name=f"{side} foot"))
    away = kv.translation(lean) @ hand(start)
    tasks.append(Goal(same_pose(away, hand), name=f"{side} hand", gain=200, weight=[1] * 3 + [0.04] * 3))
    pairs += [Rule(f"{side}_palm", other, check=True) for other in ("table", f"{side}_thigh")]
scene = Scene(model, rules=pairs)
controller = Controller(model, tasks, dt=0.005, scene=scene, contacts=4, margin=0.05, radius=0.1)

if __name__ == "__main__":
    state = start
    for now in np.arange(0, 5, controller.dt):
        controller.set(time, now)
        command = controller.step(state)
        state = model.integrate(state, command.speeds, controller.dt)
    print(", ".join(f"{name}: {error:.2g}" for name, error in command.residuals.items()))
    print(f"nearest pair: {min(scene.pairs_within(1.0).distances):.3f} m")
