"""Pictures of the examples: each script runs, and what it computed is drawn."""

from __future__ import annotations

import contextlib
import io
import os
import runpy
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from figures_as_pixels import draw_figure
from matplotlib.figure import Figure
from PIL import Image

import kineverse as kv
from kineverse.lie import translation
from kineverse.model.body import Body, Box, Capsule, Pose, Shape
from kineverse.view import Camera, draw_finding, picture
from kineverse.view.clips import ClipMoment, draw_clip
from kineverse.view.drawables import TRACE, Drawable, build_spheres, draw_frame_path, draw_ghosts
from kineverse.view.pictures import join_pictures
from kineverse.view.plots import draw_fit
from kineverse.view.proximity import build_arrow
from kineverse.view.rendering.camera import fit_camera

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SIZE = (480, 320)
FRIDGE = Camera((-2.1, -2.6, 2.1), (0.9, -0.6, 0.8), field_of_view=0.62)  # the shipped kitchen's corner
OPEN_FRIDGE = Camera((-1.3, 0.9, 2.3), (0.66, -1.3, 0.8), field_of_view=0.66)  # from the other side
PAINT = (0.30, 0.47, 0.62, 1.0)


def run_example(name: str, *words: str) -> dict[str, Any]:
    """Run an example without its output; return what it defined, and the pictures it wrote by file name."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        before = os.getcwd()
        os.chdir(folder)
        try:
            with patch.object(sys, "argv", [name, *words]):
                found = runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__" if words else name)
        finally:
            os.chdir(before)
        written = {
            path.name: np.asarray(Image.open(path).convert("RGB")) for path in Path(folder).glob("*.png")
        }
    return found | written


def fit_picture(pixels: np.ndarray, width: int = SIZE[0]) -> np.ndarray:
    """Return a picture at a width [pixels]."""
    height = round(pixels.shape[0] * width / pixels.shape[1])
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.LANCZOS))


def add_bars(model: kv.Model, radius: float) -> kv.Model:
    """Give a model without bodies a bar between each frame and those that are fixed in it or turn in it.

    Of frames in one direction, the farthest has the bar. Each bar is a little thinner than the one before, so
    that where two meet, neither flickers through the other.
    """
    ends: dict[tuple[str, tuple[float, ...]], tuple[float, np.ndarray]] = {}
    for name, frame in model.frames.items():
        place = frame.transform[:3, 3]
        if name == "world" or place.symbols:
            continue
        length = float(np.linalg.norm(place()))
        if length > 2 * radius:
            along = place() / length
            way = (frame.parent, tuple(along.round(6)))
            ends[way] = max(ends.get(way, (0.0, along)), (length, along), key=lambda end: end[0])
    with model.edit() as edit:
        for number, ((parent, _), (length, along)) in enumerate(ends.items()):
            side = np.cross(along, np.roll(along, 1) + np.array([0.1, 0.2, 0.3]))
            side /= np.linalg.norm(side)
            pose = np.eye(4)
            pose[:3, :3] = np.array([side, np.cross(along, side), along]).T
            pose[:3, 3] = along * length / 2
            bar = Shape(Capsule(radius * 0.97**number, length), Pose.from_matrix(pose))
            edit.add_frame(f"bar {number}", parent, body=Body((bar,)))
    return model


def draw_swing(
    model: kv.Model, name: str, low: float, high: float, azimuth: float, count: int = 24
) -> list[np.ndarray]:
    """Return the pictures of a coordinate that goes from one value to another and back."""
    angle = 2 * np.pi * np.arange(count) / count
    values = low + (high - low) * (0.5 - 0.5 * np.cos(angle))
    points = np.concatenate([[model.fk(frame)({name: v})[:3, 3] for frame in model.frames] for v in values])
    margin = 0.06 * np.ptp(points, axis=0).max()
    corners = np.concatenate([points - margin, points + margin])
    eye = fit_camera(corners, azimuth, 0.25, SIZE[0] / SIZE[1], 0.4)
    return list(draw_clip(model, [ClipMoment({name: float(v)}) for v in values], SIZE, eye))


def load_and_view() -> np.ndarray:
    found = run_example("01_load_and_view", "--headless")
    eye = Camera((-4.2, -3.6, 3.2), (0.35, -0.1, 0.6), field_of_view=0.6)
    return picture(found["model"], found["state"], SIZE, eye)


def forward_kinematics() -> np.ndarray:
    """Return the PR2, and for each joint an arrow: the velocity of the gripper if it turns by 0.3 rad/s."""
    found = run_example("02_forward_kinematics_and_jacobians")
    model, state = found["model"], found["state"]
    tool = model.fk("pr2/r_gripper_tool_frame")
    tip = tool(state)[:3, 3]
    columns = model.jacobian("pr2/r_gripper_tool_frame", symbols=found["joints"])(state)[:3].T
    arrows = [
        Drawable("world", piece, (0.86, 0.16, 0.16, 1.0), "visual")
        for column in columns
        if np.linalg.norm(column) > 1e-3
        for piece in build_arrow(np.array([tip, tip + 0.3 * column]), 0.25)
    ]
    eye = Camera((2.5, -2.4, 1.9), (0.3, -0.2, 0.75), field_of_view=0.5)
    return picture(model, state, SIZE, eye, over=arrows)


def violations() -> np.ndarray:
    found = run_example("04_constraints_and_violations")
    return picture(
        found["model"], {"kitchen/fridge_door": 1.5, "kitchen/oven_left_drawer": 0.4}, SIZE, FRIDGE
    )


def with_door(model: kv.Model, handle: str, width: float) -> kv.Model:
    """Give the door of a model a leaf and a knob."""
    leaf = Shape(
        Box((width, 0.03, 0.9)), Pose.from_matrix(translation(np.array([width / 2, 0, 0]))), color=PAINT
    )
    knob = Shape(Box((0.03, 0.09, 0.16)), color=(0.8, 0.3, 0.15, 1.0))
    with model.edit() as edit:
        edit.add_frame("leaf", "door", body=Body((leaf,)))
        edit.add_frame("knob", handle, body=Body((knob,)))
    return model


def edit_a_model() -> np.ndarray:
    """Return the door before the edit as a ghost, and where it is after it."""
    found = run_example("05_edit_a_running_model")
    model = with_door(found["model"], "handle", 0.45)
    before = found["before"].fk("door")({"door": 0.5})
    after = model.fk("door")({"door": 0.5})
    moved = before @ np.linalg.inv(after)
    ghosts = [
        Drawable("world", part.surface.transform(moved), part.color, part.kind)
        for part in draw_ghosts(model, ["leaf", "knob"], [kv.State({model.symbol("door"): 0.5})])
    ]
    eye = Camera((2.6, -1.8, 1.2), (0.2, 0.6, -0.05), field_of_view=0.48)
    return picture(model, {"door": 0.5}, SIZE, eye, overlay=ghosts)


def compile_and_batch() -> np.ndarray:
    found = run_example("06_compile_and_batch")
    positions = found["poses"][:, :3, 3]

    def draw(canvas: Figure) -> None:
        axes = canvas.subplots()
        shown = axes.hexbin(positions[:, 0], positions[:, 2], gridsize=60, bins="log", mincnt=1)
        axes.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", title="100 000 poses of the gripper")
        canvas.colorbar(shown, ax=axes, label="states")

    return draw_figure(draw, SIZE)


def tendon_finger() -> list[np.ndarray]:
    found = run_example("08_tendon_finger")
    return draw_swing(add_bars(found["model"], 0.007), "finger/tendon", 0.0, 0.036, -np.pi / 2 + 0.3)


def rocker_switch() -> np.ndarray:
    """Return the torque of the spring, and how the switch goes to its rests when it is released."""
    found = run_example("09_rocker_switch")
    q, torque, model = found["q"], found["torque"], found["model"]

    def draw(canvas: Figure) -> None:
        left, right = canvas.subplots(1, 2)
        angles = np.linspace(-0.25, 0.25, 80)
        left.plot(angles, [torque({q: a}) for a in angles])
        left.plot([-0.2, 0.2], [0, 0], "o", color="tab:green", label="stable")
        left.plot([0], [0], "o", color="tab:red", label="unstable")
        left.axhline(0, color="0.8", linewidth=0.8, zorder=0)
        left.set(xlabel="angle [rad]", ylabel="torque [N m]")
        left.legend(fontsize="small")
        for pressed in np.linspace(-0.24, 0.24, 9):
            state, way = model.default_state().updated({q: pressed}), [pressed]
            for _ in range(120):
                state = model.integrate(state, {q.derivative(): 10 * torque(state)}, dt=0.01)
                way.append(state[q])
            right.plot(0.01 * np.arange(len(way)), way, color="tab:blue", linewidth=1)
        right.set(xlabel="time [s]", ylabel="angle [rad]")

    return draw_figure(draw, SIZE)


def ironing_board() -> list[np.ndarray]:
    """Return the legs under the board as the slider moves in its rail."""
    model = add_bars(run_example("10_ironing_board")["model"], 0.02)
    board = Shape(
        Box((1.3, 0.35, 0.03)), Pose.from_matrix(translation(np.array([0.5, 0.0, 0.04]))), color=PAINT
    )
    with model.edit() as edit:
        edit.add_frame("board", "world", body=Body((board,)))
    return draw_swing(model, "slider", 0.35, 0.8, -np.pi / 2 + 0.4)


def locks() -> np.ndarray:
    """Return the safe shut, with its key turned, and open with its bolt back."""
    model = run_example("11_locks_and_interlocks")["model"]
    shapes = {
        "door": ((0.5, 0.04, 0.6), (0.25, 0.0, 0.0), PAINT),
        "key": ((0.03, 0.16, 0.03), (0.38, 0.0, -0.05), (0.85, 0.65, 0.2, 1.0)),
        "bolt": ((0.05, 0.03, 0.2), (0.5, 0.0, 0.37), (0.8, 0.3, 0.15, 1.0)),
    }
    with model.edit() as edit:
        for name, (size, at, color) in shapes.items():
            body = Body((Shape(Box(size), Pose.from_matrix(translation(np.array(at))), color=color),))
            edit.add_frame(f"{name}/body", name, body=body)
    states = ({}, {"safe/key": 1.57}, {"safe/key": 1.57, "safe/bolt": 0.03, "safe/door": 1.0})
    eye = Camera((1.6, -1.7, 0.6), (0.25, 0.0, 0.03), field_of_view=0.5)
    return join_pictures([[picture(model, state, (157, 200), eye) for state in states]])


def distances() -> np.ndarray:
    """Return the fridge ajar, with the way from its handle to what the example measures its distance to."""
    found = run_example("12_collision_distances")
    scene, state = found["scene"], found["state"].updated({"kitchen/fridge_door": 0.7})
    scene.update(state)
    pair = scene.distance("kitchen/fridge_door_handle", "kitchen/sink_area")
    ends = np.array([pair.point_a, pair.point_b])
    way = [Drawable("world", piece, TRACE, "visual") for piece in build_arrow(ends, 0.4)]
    eye = Camera((-2.0, -1.6, 2.0), (0.6, -1.1, 0.95), field_of_view=0.36)
    return picture(found["model"], state, SIZE, eye, over=way)


def identify_a_joint() -> np.ndarray:
    found = run_example("13_identify_a_joint")
    relative = np.linalg.inv(found["walls"]) @ found["doors"]
    return fit_picture(
        draw_figure(
            lambda canvas: draw_fit(canvas, found["best"], relative, "25 noisy poses of a door"), (1150, 520)
        ),
        720,
    )


def track_a_state() -> np.ndarray:
    """Return the estimated state, with the positions that were seen as points."""
    seen = []
    update = kv.estimation.Tracker.update

    def keep(tracker: Any, poses: Mapping[str, Any], *rest: Any, **more: Any) -> Any:
        seen.extend(pose[:3, 3] for pose in poses.values())
        return update(tracker, poses, *rest, **more)

    with patch.object(kv.estimation.Tracker, "update", keep):
        found = run_example("14_track_a_state")
    model, estimate = found["model"], found["estimate"]
    points = build_spheres(np.array(seen), np.full(len(seen), 0.012))
    state = {name: estimate.state[name] for name in found["truth"]}
    return picture(model, state, SIZE, FRIDGE, over=[Drawable("world", points, TRACE, "visual")])


def convert_formats() -> np.ndarray:
    found = run_example("15_convert_formats")
    return picture(found["door"], {"hinge": 0.7}, SIZE)


def operation_of_your_own() -> np.ndarray:
    """Return the door of the example, and the wider one of the reader, whose handle has followed."""
    found = run_example("17_operation_of_your_own")
    panels = []
    eye = Camera((2.0, -2.3, 0.9), (0.42, 0.0, 0.0), field_of_view=0.5)
    for model, width in ((found["model"], 0.8), (found["read"], 1.0)):
        panels.append(picture(with_door(model, "door/handle", width), {}, (238, 240), eye))
    return join_pictures([panels])


def reach() -> np.ndarray:
    found = run_example("18_reach", "pr2")
    return fit_picture(found["reach.png"], 720)


def open_a_door() -> np.ndarray:
    found = run_example("19_open_a_door", "--headless")
    return picture(found["model"], found["state"], SIZE, OPEN_FRIDGE)


def plan_a_motion() -> np.ndarray:
    found = run_example("20_plan_a_motion", "--headless")
    model, path = found["model"], found["path"]
    bodies = [
        name
        for name in model.bodies
        if model.fk(name).symbols and not {*model.fk(name).symbols}.isdisjoint(found["arm"])
    ]
    times = np.linspace(0.0, 1.0, 5)
    overlay = draw_ghosts(model, bodies, [path.at(t) for t in times[:-1]])
    overlay.append(draw_frame_path(model, "fetch/gripper_link", [path.at(t) for t in np.linspace(0, 1, 80)]))
    eye = Camera((-1.3, 0.9, 2.3), (0.75, -1.05, 0.95), field_of_view=0.6)
    return picture(model, path.at(1.0), SIZE, eye, overlay=overlay)


def live_system() -> np.ndarray:
    found = run_example("21_live_system", "--headless")
    return fit_picture(found["live.png"])


def calibrate() -> np.ndarray:
    """Return the PR2 with its arm where the camera looked at it, of which some looks are drawn."""
    found = run_example("22_calibrate")
    model = found["model"]
    states = [kv.State({model.symbol(n): v for n, v in look[0].items()}) for look in found["looks"][:6]]
    arm = {model.symbol(name) for name in found["JOINTS"][:7]}
    bodies = [name for name in model.bodies if arm & {*model.fk(name).symbols}]
    eye = Camera((2.7, -1.6, 1.7), (0.25, -0.25, 0.75), field_of_view=0.6)
    return picture(model, states[0], SIZE, eye, overlay=draw_ghosts(model, bodies, states[1:]))


def learn_a_hinge() -> np.ndarray:
    """Return the seen points from above, and those that the learned hinge gives."""
    found = run_example("23_learn_a_hinge")
    hinge = np.tile(found["found"], (30, 1))
    learned = np.asarray(found["points"](np.column_stack([np.asarray(found["unknown"]["angles"]), hinge])))
    seen = np.asarray(found["seen"])

    def draw(canvas: Figure) -> None:
        axes = canvas.subplots()
        for k in range(4):
            axes.plot(learned[:, k, 0], learned[:, k, 1], color="tab:blue", linewidth=1)
        axes.scatter(seen[..., 0], seen[..., 1], s=5, color="0.35", label="seen")
        axes.plot(
            found["found"][0], found["found"][1], "+", color="tab:red", markersize=12, label="learned hinge"
        )
        axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="four points on a door, from above")
        axes.legend(fontsize="small")

    return draw_figure(draw, SIZE)


def check_a_model() -> np.ndarray:
    """Return the first finding of the check, as ``kineverse validate --motion`` draws it."""
    kept = []
    check = kv.geometry.check_motion

    def keep(model: kv.Model, *rest: Any, **more: Any) -> Any:
        report = check(model, *rest, **more)
        kept.append((model.snapshot(), report))
        return report

    with patch.object(kv.geometry, "check_motion", keep):
        run_example("24_check_a_model")
    model, report = kept[0]
    drawn = draw_finding(model, report["drawer"].suspects[0])
    assert drawn is not None
    return fit_picture(drawn)


EXAMPLE_PICTURES: dict[str, Callable[[], Any]] = {
    "01_load_and_view": load_and_view,
    "02_forward_kinematics_and_jacobians": forward_kinematics,
    "04_constraints_and_violations": violations,
    "05_edit_a_running_model": edit_a_model,
    "06_compile_and_batch": compile_and_batch,
    "08_tendon_finger": tendon_finger,
    "09_rocker_switch": rocker_switch,
    "10_ironing_board": ironing_board,
    "11_locks_and_interlocks": locks,
    "12_collision_distances": distances,
    "13_identify_a_joint": identify_a_joint,
    "14_track_a_state": track_a_state,
    "15_convert_formats": convert_formats,
    "17_operation_of_your_own": operation_of_your_own,
    "18_reach": reach,
    "19_open_a_door": open_a_door,
    "20_plan_a_motion": plan_a_motion,
    "21_live_system": live_system,
    "22_calibrate": calibrate,
    "23_learn_a_hinge": learn_a_hinge,
    "24_check_a_model": check_a_model,
}

MOVING_EXAMPLES = ("08_tendon_finger", "10_ironing_board")
"""Examples whose pictures are a clip."""
