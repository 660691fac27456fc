"""A robot plans a way past the open door of a fridge and into it (extra ``geometry``, and a C compiler).

The page in the browser plays it; with ``--headless`` the picture plan.png is written instead.
"""

import sys

import kineverse as kv
from kineverse.planning import Planner
from kineverse.view import save_picture

model = kv.load("kitchen")
model.include("fetch")
arm = [s for s in model.symbols_of("fetch/gripper_link") if "base" not in str(s)]
planner = Planner(model, arm, protrusion=0.04)  # coarse spheres, which are found sooner
planner.place({"fetch/base/x": 0.3, "fetch/base/y": -1.3, "kitchen/fridge_door": 1.5})

beside, inside = (
    planner.hold("fetch/gripper_link", "world", mask="xyz", offset=kv.translation(*p))
    for p in ((0.8, -0.6, 1.1), (1.35, -1.4, 1.2))
)
start = planner.solutions(beside, count=1)[0]
path = planner.plan(start, inside, seconds=5.0)
if not path:
    sys.exit(path.why)
trajectory = path.trajectory()
print(
    f"{len(planner.symbols)} joints, {len(path)} points, {path.length:.2f} rad in {trajectory.duration:.2f} s"
)
print(f"nothing is nearer than {1000 * path.clearance():.1f} mm")
if "--headless" in sys.argv:
    save_picture("plan.png", model, path.at(1.0))
else:
    page = kv.show(model, path.at(0.0), block=False)
    page.play(trajectory, loop=True)
    page.wait()
