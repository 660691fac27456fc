"""Laws of controllers at many random states: `python tools/feasible_states.py [--states N] [--recoveries N]`.

For robots in the shipped kitchen and several sets of tasks: a step is feasible at random states far outside
of the limits. From states that the speed limits can leave in time, with a goal within reach, all violations
vanish within 5 s.
"""

from __future__ import annotations

import argparse
import math
import sys
import time

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, Keep, same_pose

HANDS = {"pr2": "pr2/r_gripper_tool_frame", "fetch": "fetch/gripper_link", "hsr": "hsr/hand_palm_link"}
DT, SECONDS = 0.02, 5.0


def task_sets(model: kv.Model, hand: str, reachable: np.ndarray) -> dict[str, list]:
    """Return several sets of tasks by name."""
    door, pose = model.symbol("kitchen/fridge_door"), model.fk(hand)
    goal = Goal(pose[:3, 3], reachable, name="reach")
    held = Hold(same_pose(pose, model.fk("kitchen/fridge_door_handle")), name="grasp")
    keep = Keep(0.2, pose[2, 3], 1.4, name="height")
    opened = Goal(door, 0.8, name="open")
    return {
        "goal": [goal],
        "goal, keep": [goal, keep],
        "hold, goal": [held, opened],
        "hold, goal, keep": [held, opened, keep],
        "two goals": [goal, opened],
    }


def random_state(
    model: kv.Model, symbols: list, generator: np.random.Generator, recoverable: bool
) -> kv.State:
    """Return a state outside of its limits; if recoverable, by half of what the speed limits reach."""
    values = {}
    for symbol in symbols:
        lower, upper = model.limits(symbol)
        if not (math.isfinite(lower) and math.isfinite(upper)):
            values[symbol] = generator.uniform(-2, 2)
            continue
        beyond = 0.5 * (upper - lower) + 0.1
        if recoverable:
            speed = model.limits(symbol.derivative())[1]
            beyond = min(0.3, beyond, 0.4 * SECONDS * speed)
        values[symbol] = generator.uniform(lower - beyond, upper + beyond)
    return model.default_state().updated(values)


def main() -> int:
    """Check the law; return 0 if it holds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=10_000, help="random states in all")
    parser.add_argument("--recoveries", type=int, default=1000, help="of these followed for 5 s")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    generator = np.random.default_rng(given.seed)
    sets, failed = 5 * len(HANDS), 0
    for robot, hand in HANDS.items():
        model = kv.load(robot)
        model.include("kitchen")
        reach = model.fk(hand)[:3, 3](model.default_state()) + np.array([0.1, 0.0, 0.05])
        for name, tasks in task_sets(model, hand, reach).items():
            start = time.time()
            controller = Controller(model, tasks, dt=DT)
            controller.wait(60)
            symbols = [s for s in controller.inputs if s in model.degrees_of_freedom]
            infeasible = 0
            for _ in range(given.states // sets):
                controller.reset()
                try:
                    controller.step(random_state(model, symbols, generator, recoverable=False))
                except kv.errors.InfeasibleError as error:
                    infeasible += 1
                    print(error, file=sys.stderr)
            before, worst, count = 0.0, 0.0, 0
            if "hold" not in name:  # from far outside a hold is a contradictory task
                integrator, checker = model.integrator(controller.speeds), model.constraint_checker()
                place = [model.symbols.index(s) for s in controller.inputs]
                for _ in range(given.recoveries // (3 * len(HANDS))):
                    q = random_state(model, symbols, generator, recoverable=True).vector(model.symbols)
                    controller.reset()
                    before = max(before, checker(q))
                    for _ in range(round(SECONDS / DT)):
                        command = controller.step(q[place])
                        q = integrator(q, list(command.speeds.values()), DT)
                    worst, count = max(worst, checker(q)), count + 1
            failed += infeasible + (worst > 1e-6)
            print(
                f"{robot:6} {name:18} infeasible {infeasible} of {given.states // sets}; largest violation "
                f"{before:.2f}, after {SECONDS:g} s {worst:.1e} in {count}; {time.time() - start:.0f} s"
            )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
