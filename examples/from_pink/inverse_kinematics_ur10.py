"""Find joint positions of a UR10 for reachable poses; pink's example ``inverse_kinematics_ur10.py``."""

import numpy as np

import kineverse as kv
from kineverse.control import Goal, InverseKinematics, Target, same_pose

model = kv.load("ur_description/urdf/ur10_robot.urdf")
hand = model.fk("wrist_3_link")
target = Target("target", np.eye(4))
solver = InverseKinematics(model, [Goal(same_pose(target.expression, hand), name="hand")], tolerance=1e-8)

if __name__ == "__main__":
    lower, upper = np.array([model.limits(joint) for joint in hand.symbols]).T
    states = np.random.default_rng(0).uniform(lower, upper, (20, len(lower)))
    found = [solver.solve(target.values(pose)) for pose in kv.compile(hand, hand.symbols).batch(states)]
    print(f"{sum(result.solved for result in found)} of {len(found)} poses reached")
    print(f"largest error: {max(result.residuals['hand'] for result in found):.1g}")
