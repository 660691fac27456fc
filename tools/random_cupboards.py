"""Robots at random cupboards with something in the way or beside it: `python tools/random_cupboards.py`.

A cupboard has a door, a flap or a drawer of random size, side, axis and handle. A post, a board, the corner
of a wall, or a second door or drawer stands in its swing or slide in half of the cupboards, and near to it in
the others. Robots open, close and push. The laws:

- nothing is done, by the word of the skill, in which furniture overlaps by more than 0.5 mm in any state of
  the world, unless it did at the start, or which did not end at its target. That is judged by coal on shapes,
  axes and formulas of this file, and not by the library's scene or judge.
- of the cupboards with nothing in the way, 95 % are done.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import coal
import numpy as np

from kineverse.manipulation import Outcome, Session, open_object
from kineverse.manipulation.pushing.push_controller import Pushing
from kineverse.manipulation.robot_sources import SHIPPED
from kineverse.worlds import KinematicWorld, RunMetrics, TrueBelief
from kineverse_studies.experiments.manipulation.skills import try_push

ROBOTS = ("hsr", "pr2", "fetch")
SKILLS = ("open", "close", "push")
KINDS = ("door", "flap", "drawer")
OBSTACLES = ("post", "board", "corner", "door", "drawer")
ALLOWED = 5e-4
"""Depth of an overlap that does not count [m]."""
CLEAR, DEEP = 0.012, 0.01
"""Least distance of what is not in the way, and least depth of what is [m]: nothing in between is drawn."""
BOARD, PANEL, GAP = 0.016, 0.018, 0.003
"""Thickness of boards and of fronts, and the gap between them [m]."""
SAMPLES = 160
"""Values at which a way is looked at when cupboards are drawn."""


@dataclass
class Link:
    """Boxes and cylinders that move together about or along an axis through a point."""

    name: str
    shapes: list[tuple[str, tuple[float, ...], np.ndarray]] = field(default_factory=list)
    kind: str = "fixed"
    point: np.ndarray = field(default_factory=lambda: np.zeros(3))
    axis: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    upper: float = 0.0

    def box(self, size: tuple[float, ...], at: tuple[float, ...]) -> None:
        """Add a box in the world, where the link is at 0."""
        self.shapes.append(("box", tuple(map(float, size)), shift(*at)))

    def rod(self, radius: float, length: float, at: tuple[float, ...], along: int) -> None:
        """Add a cylinder along an axis of the world."""
        turned = shift(*at)
        turned[:3, :3] = {0: turn((0, 1, 0), math.pi / 2), 1: turn((1, 0, 0), math.pi / 2), 2: np.eye(3)}[
            along
        ]
        self.shapes.append(("cylinder", (radius, length), turned))

    def pose(self, q: float) -> np.ndarray:
        """Return how the link is displaced at a value of its joint, (4, 4)."""
        moved = np.eye(4)
        if self.kind == "prismatic":
            moved[:3, 3] = q * self.axis
        elif self.kind == "revolute":
            moved[:3, :3] = turn(self.axis, q)
            moved[:3, 3] = self.point - moved[:3, :3] @ self.point
        return moved


def shift(x: float, y: float, z: float) -> np.ndarray:
    """Return a translation."""
    moved = np.eye(4)
    moved[:3, 3] = x, y, z
    return moved


def turn(axis: np.ndarray | tuple[float, ...], angle: float) -> np.ndarray:
    """Return a rotation by Rodrigues' formula."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=float)
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


@dataclass
class Cupboard:
    """Carcass, object, obstacle, and the task."""

    number: int
    links: list[Link]
    skill: str
    start: float
    target: float
    values: dict[str, float]
    blocked: bool
    about: str

    @property
    def object(self) -> Link:
        """The link that is to move."""
        return next(link for link in self.links if link.name == "front")

    def urdf(self) -> str:
        """Return the cupboard as a description."""
        lines = [f'<robot name="cupboard_{self.number}"><link name="root"/>']
        for link in self.links:
            lines.append(f'<link name="{link.name}">')
            for kind, size, pose in link.shapes:
                numbers = (
                    f'size="{_text(size)}"'
                    if kind == "box"
                    else f'radius="{size[0]:.17g}" length="{size[1]:.17g}"'
                )
                x, y, z = pose[:3, 3] - link.point
                roll, pitch = math.atan2(pose[2, 1], pose[2, 2]), math.asin(max(-1.0, min(1.0, -pose[2, 0])))
                place = f'<origin xyz="{x:.17g} {y:.17g} {z:.17g}" rpy="{roll:.17g} {pitch:.17g} 0"/>'
                shape = f"{place}<geometry><{kind} {numbers}/></geometry>"
                lines.append(f"<visual>{shape}</visual><collision>{shape}</collision>")
            inertia = 'ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"'
            lines.append(f'<inertial><mass value="3"/><inertia {inertia}/></inertial></link>')
            limit = f'<limit lower="0" upper="{link.upper:.17g}" velocity="1" effort="100"/>'
            moves = f'<axis xyz="{_text(link.axis)}"/>{limit}' if link.kind != "fixed" else ""
            lines.append(
                f'<joint name="{link.name}_joint" type="{link.kind}"><parent link="root"/>'
                f'<child link="{link.name}"/><origin xyz="{_text(link.point)}"/>{moves}</joint>'
            )
        return "".join([*lines, "</robot>"])


def _text(numbers: np.ndarray | tuple[float, ...]) -> str:
    return " ".join(f"{n:.17g}" for n in numbers)


class Judge:
    """Overlaps of the links of a cupboard by coal, each shape with each one."""

    def __init__(self, links: list[Link]) -> None:
        self.links = links
        self.shapes = [[_solid(kind, size) for kind, size, _ in link.shapes] for link in links]
        self.pairs = [
            (i, j)
            for i in range(len(links))
            for j in range(i)
            if links[i].kind != "fixed" or links[j].kind != "fixed"
        ]
        self.spheres = [
            [float(np.linalg.norm(size) / (2 if kind == "box" else 1)) for kind, size, _ in link.shapes]
            for link in links
        ]

    def distances(self, values: dict[str, float], radius: float = 0.05) -> dict[tuple[str, str], float]:
        """Return the signed distances of the links that are within a radius [m]."""
        poses = [link.pose(values.get(link.name, 0.0)) for link in self.links]
        placed = [[T @ pose for _, _, pose in link.shapes] for link, T in zip(self.links, poses, strict=True)]
        found = {}
        for i, j in self.pairs:
            least = math.inf
            for a, A, r in zip(self.shapes[i], placed[i], self.spheres[i], strict=True):
                for b, B, s in zip(self.shapes[j], placed[j], self.spheres[j], strict=True):
                    if np.linalg.norm(A[:3, 3] - B[:3, 3]) - r - s > radius:
                        continue
                    placed_a, placed_b = (coal.Transform3s(T[:3, :3], T[:3, 3]) for T in (A, B))
                    request, result = coal.DistanceRequest(), coal.DistanceResult()
                    least = min(least, coal.distance(a, placed_a, b, placed_b, request, result))
            if least < radius:
                found[self.links[i].name, self.links[j].name] = least
        return found

    def overlaps(self, states: list[dict[str, float]]) -> dict[tuple[str, str], float]:
        """Return the largest depths of pairs, without small ones, and pairs that overlap at the start."""
        first = self.distances(states[0])
        deepest: dict[tuple[str, str], float] = {}
        for values in states:
            for pair, distance in self.distances(values).items():
                if -distance > ALLOWED and first.get(pair, 1.0) >= -ALLOWED:
                    deepest[pair] = max(deepest.get(pair, 0.0), -distance)
        return deepest


def _solid(kind: str, size: tuple[float, ...]) -> coal.CollisionGeometry:
    return coal.Box(*size) if kind == "box" else coal.Cylinder(*size)


# -- drawing -----------------------------------------------------------------------------------------------


def draw_cupboard(number: int, seed: int) -> Cupboard:
    """Return a cupboard, blocked if its number is even."""
    random = np.random.default_rng([seed, number])
    wanted = number % 2 == 0
    skill = SKILLS[int(random.integers(3))]
    while True:
        found = _draw(number, skill, random)
        if found is not None and found.blocked == wanted:
            return found


def _draw(number: int, skill: str, random: np.random.Generator) -> Cupboard | None:
    """Return a cupboard; None if it is neither clearly blocked nor clearly free."""
    kind, what = str(random.choice(KINDS)), str(random.choice(OBSTACLES))
    x, z = random.uniform(0.9, 1.1), random.uniform(0.55, 0.95)
    width, height, depth = random.uniform((0.3, 0.25, 0.3), (0.7, 0.55, 0.45)).tolist()
    if kind == "drawer":
        height = random.uniform(0.12, 0.25)
    carcass = _make_carcass("carcass", x, 0.0, z, width, height, depth)
    front = _make_front("front", kind, x, 0.0, z, width, height, depth, random)
    obstacle, value = _make_obstacle(what, front, x, z, width, height, random)
    links = [carcass, front, *obstacle]
    values = {} if value is None else {"other": value}
    share = random.uniform(0.5, 1.0)
    opened = front.upper if skill == "open" else front.upper * share
    start, target = (0.0, opened) if skill == "open" else (opened, 0.0)
    judge = Judge(links)
    if any(d < CLEAR / 2 for pair, d in judge.distances({"front": start} | values).items() if _other(pair)):
        return None
    least, way = math.inf, np.linspace(start, target, SAMPLES)
    for q in way.tolist():
        found = judge.distances({"front": q} | values)
        if any(d < -ALLOWED for pair, d in found.items() if not _other(pair)):
            return None  # the cupboard is to be right in itself
        least = min(least, *(d for pair, d in found.items() if _other(pair)), math.inf)
    if -DEEP < least < CLEAR:
        return None
    about = f"{skill} {kind} {width:.2f} x {height:.2f} m, {what}"
    return Cupboard(number, links, skill, start, target, values, least < 0.0, about)


def _other(pair: tuple[str, str]) -> bool:
    return "front" in pair and not {"carcass"} & {*pair}


def _make_carcass(name: str, x: float, y: float, z: float, width: float, height: float, depth: float) -> Link:
    link, middle = Link(name), x + depth / 2
    for side in (-1, 1):
        link.box((depth, BOARD, height), (middle, y + side * (width - BOARD) / 2, z))
        link.box((depth, width, BOARD), (middle, y, z + side * (height - BOARD) / 2))
    link.box((BOARD, width, height), (x + depth - BOARD / 2, y, z))
    return link


def _make_front(
    name: str,
    kind: str,
    x: float,
    y: float,
    z: float,
    width: float,
    height: float,
    depth: float,
    random: np.random.Generator,
) -> Link:
    """Return a door, flap or drawer in front of a carcass, with a handle."""
    link = Link(name, kind="prismatic" if kind == "drawer" else "revolute")
    face = x - GAP - PANEL
    link.box((PANEL, width, height), (face + PANEL / 2, y, z))
    level, length = kind != "door", random.uniform(0.1, 0.16)
    side = int(random.choice((-1, 1)))
    if kind == "drawer":
        link.axis, link.upper = np.array([-1.0, 0.0, 0.0]), random.uniform(0.6, 0.9) * (depth - BOARD)
        inner = depth - BOARD - 0.02
        link.box(
            (inner, width - 2 * BOARD - 0.01, 0.01),
            (face + PANEL + inner / 2, y, z - height / 2 + BOARD + 0.01),
        )
        at = (face - 0.05, y, z)
    elif kind == "door":
        link.point = np.array([face, y + side * width / 2, z])
        link.axis, link.upper = np.array([0.0, 0.0, -float(side)]), random.uniform(1.2, 1.7)
        at = (face - 0.05, y - side * (width / 2 - 0.05), z)
    else:
        link.point = np.array([face, y, z - height / 2])
        link.axis, link.upper = np.array([0.0, -1.0, 0.0]), random.uniform(1.1, 1.5)
        at = (face - 0.05, y, z + height / 2 - 0.05)
    along = 1 if level else 2
    link.rod(0.006, length, at, along)
    for end in (-1, 1):
        mount = list(at)
        mount[0] = face - 0.025
        mount[along] += end * (length / 2 - 0.012)
        link.rod(0.004, 0.05, tuple(mount), 0)
    return link


def _make_obstacle(
    what: str, front: Link, x: float, z: float, width: float, height: float, random: np.random.Generator
) -> tuple[list[Link], float | None]:
    """Return the links of an obstacle near to the way of a front, and the value of its joint."""
    reach = 0.1 + (front.upper if front.kind == "prismatic" else max(width, height))
    link = Link("obstacle")
    if what == "post":
        size = random.uniform(0.03, 0.08)
        link.box((size, size, 1.7), (random.uniform(x - reach, x - 0.05), random.uniform(-0.8, 0.8), 0.85))
        return [link], None
    if what == "board":
        flat = random.random() < 0.5
        size = (0.3, 0.4, 0.02) if flat else (0.02, 0.4, 0.3)
        at = random.uniform((x - reach, -0.7, z - 0.5), (x - 0.1, 0.7, z + 0.5))
        link.box(size, tuple(at))
        return [link], None
    if what == "corner":
        side, far = random.choice((-1, 1)), random.uniform(0.0, 0.5)
        link.box((0.6, 0.1, 2.0), (x - 0.3, side * (width / 2 + far + 0.05 + GAP), 1.0))
        return [link], None
    # A second cupboard beside the first one, with a door or drawer that stands open.
    side, other_width = random.choice((-1, 1)), random.uniform(0.3, 0.5)
    y = side * (width / 2 + other_width / 2 + random.uniform(0.01, 0.1))
    forth = random.uniform(-0.2, 0.1)
    case = _make_carcass("neighbour", x + forth, y, z, other_width, 0.3, 0.4)
    other = _make_front("other", what, x + forth, y, z, other_width, 0.3, 0.4, random)
    return [case, other], float(random.uniform(0.3, 1.0) * other.upper)


# -- running -----------------------------------------------------------------------------------------------


@dataclass
class Run:
    """What a robot did at a cupboard, and what is wrong with it."""

    outcome: Outcome
    wrong: str
    seconds: float


def run_robot(robot: str, cupboard: Cupboard, folder: Path) -> Run:
    """Let a robot do the task of a cupboard in the kinematic world, and judge it."""
    path = folder / f"cupboard_{cupboard.number}.urdf"
    path.write_text(cupboard.urdf(), encoding="utf-8")
    begin = time.process_time()
    source = SHIPPED[robot]
    model = source.load()
    model.include(path, prefix="cupboard")
    what = model.symbol("cupboard/front_joint")
    state = source.start_state(model).updated({what: cupboard.start, f"{robot}/base/x": -0.8})
    state = state.updated({f"cupboard/{name}_joint": value for name, value in cupboard.values.items()})
    world = KinematicWorld(model, robot)
    world.reset(state)
    states: list[dict[str, float]] = []

    metrics = RunMetrics(world, what)

    def read() -> None:
        truth = world.state
        states.append({link.name: truth[f"cupboard/{link.name}_joint"] for link in _moving(cupboard)})

    def look(session: Session) -> None:
        read()
        metrics(session)

    def open_session() -> Session:
        return Session(world, belief=TrueBelief(world), on_step=look)

    read()
    if cupboard.skill == "push":
        bodies = world.robot.gripper().bodies
        pushing = Pushing(model, world.robot, what, bodies, state, target=cupboard.target)
        outcome, _, _ = try_push(pushing, world, state, metrics, open_session)
    else:
        outcome = open_object(open_session(), what, target=cupboard.target)
    read()
    return Run(outcome, _find_wrong(cupboard, outcome, states), time.process_time() - begin)


def _moving(cupboard: Cupboard) -> Iterator[Link]:
    return (link for link in cupboard.links if link.kind != "fixed")


def _find_wrong(cupboard: Cupboard, outcome: Outcome, states: list[dict[str, float]]) -> str:
    """Return what is wrong with an outcome that is done; empty if nothing is."""
    if not outcome.done:
        return ""
    if abs(states[-1]["front"] - cupboard.target) > 0.021:
        return f"done at {states[-1]['front']:.3f}, not at {cupboard.target:.3f}"
    found = Judge(cupboard.links).overlaps(states)
    return ", ".join(f"{a} in {b}: {1e3 * depth:.1f} mm" for (a, b), depth in found.items())


def main(words: list[str] | None = None) -> int:
    """Check the laws; return 0 if they hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100, help="number of cupboards (100)")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=ROBOTS)
    parser.add_argument("--first", type=int, default=0, help="number of the first cupboard (0)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(words)
    free = done = wrong = unmoved = 0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(arguments.first, arguments.first + arguments.count):
            cupboard = draw_cupboard(number, arguments.seed)
            for robot in arguments.robots:
                run = run_robot(robot, cupboard, Path(folder))
                free += not cupboard.blocked
                done += not cupboard.blocked and run.outcome.done
                unmoved += cupboard.blocked and not run.outcome.steps
                wrong += bool(run.wrong)
                word = f"WRONG, {run.wrong}" if run.wrong else "done" if run.outcome.done else "not done"
                state = "blocked" if cupboard.blocked else "free"
                why = "" if run.outcome.done else f": {run.outcome.reason}"
                print(
                    f"{number:4} {robot:6} {state:8} {cupboard.about:44} {run.seconds:5.1f} s  {word}{why}",
                    flush=True,
                )
    blocked = arguments.count * len(arguments.robots) - free
    print(
        f"{wrong} false; {done} of {free} with nothing in the way are done ({done / max(free, 1):.1%}); "
        f"{unmoved} of {blocked} with something in the way were refused before anything moved"
    )
    return int(wrong > 0 or done < 0.95 * free)


if __name__ == "__main__":
    sys.exit(main())
