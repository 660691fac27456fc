"""Compile expressions into a function, and evaluate it for a hundred thousand states at once."""

import time

import numpy as np

import kineverse as kv

model = kv.load("pr2")
gripper = "pr2/r_gripper_tool_frame"
f = kv.compile([model.fk(gripper), model.jacobian(gripper)])  # machine code follows in the background
print(f.inputs[:3], "...", len(f.inputs), "inputs")

pose, jacobian = f(model.default_state())  # by name; a vector in the order of f.inputs works as well
print(pose[:3, 3].round(3), jacobian.shape)

states = np.random.default_rng(0).uniform(-0.5, 0.5, (100_000, len(f.inputs)))
begin = time.perf_counter()
poses, jacobians = f.batch(states)  # vectorised, on all cores
print(poses.shape, jacobians.shape, f"in {time.perf_counter() - begin:.2f} s")

evaluator = f.bind()  # for control loops: no memory is allocated
evaluator.input[:] = states[7]
evaluator()
print(np.allclose(evaluator.outputs[0], poses[7]))
