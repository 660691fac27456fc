"""``kineverse view``: a model in the browser."""

from __future__ import annotations

import argparse
import math
import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kineverse.errors import InvalidValueError
from kineverse.geometry.exclusions import find_unusable_shapes, label_unusable_shapes
from kineverse.model.registry import find_scheme
from kineverse.planning import Trajectory
from kineverse.view import meshes, save_picture
from kineverse.view.clips import (
    ClipMoment,
    clip_times,
    draw_clip,
    is_clip_name,
    sweep_ranges,
    write_clip,
)
from kineverse.view.poses import complete
from kineverse.worlds import RunRecording, read_run_recording

from .arguments import (
    add_model_options,
    add_set_option,
    find_limit_notes,
    load_model,
    needs_mujoco,
    parse_assignments,
    parse_length,
    print_notes,
    require,
)
from .info import is_gallery_list, print_articulations, print_models
from .output import show_progress
from .pages import (
    add_page_options,
    check_picture_path,
    handle_interrupts,
    list_mesh_problems,
    page_options,
    print_address,
    print_mesh_problems,
)
from .plan_arguments import add_robot_option, include_robot

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView
    from kineverse.view.viewer import Viewer

_NICENESS = 10  # of the page of a live system

HELP = """\
The page is served to this computer only, until Ctrl-C; with --host also to others, who need the address with
its token. With --picture, a picture of the state is written instead (.png). This needs no browser, and no extra
except for meshes and --near. As .webp or .gif it is a clip: of a recording, of a trajectory, or
of all joints that move through their ranges, except those that --set names. Clips need the extra 'view'.

A recording of a run (.mcap) is played with a slider for its time: the truth, as a ghost what the robot
believes, and as arrows what its controller wants. With --play, MODEL moves along a saved trajectory.

examples:
  kineverse view kitchen
  kineverse view articulations/folding_door      any articulation of the library
  kineverse view                                 list of all models and articulations
  kineverse view my_robot.urdf --set elbow=45deg --port 8090
  kineverse view kitchen --robot fetch@0.45,0.7,90deg
  kineverse view live:home                       a model that is served: its edits, and what moves there
  kineverse view kitchen --near 5cm              bodies within 5 cm of each other
  kineverse view articulations/ratchet --near 0.1 --collisions --picture ratchet.png
  kineverse view examples/arm.urdf --play arm.json   a trajectory of kineverse plan --save arm.json
  kineverse view run.mcap                            a recording, with a slider for its time
  kineverse view run.mcap --time 3.5 --picture run.png
  kineverse view run.mcap --speed 4 --picture run.webp
  kineverse view run.mcap --plot run.svg             speeds, coordinates and contacts over time"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        nargs="?",
        help="name of a shipped model, path of a file, or a recording (.mcap); without it, a list is printed",
    )
    add_robot_option(parser)
    add_set_option(parser)
    parser.add_argument(
        "--near",
        metavar="RADIUS",
        help="show pairs of bodies within a distance (0.1, 5cm), green to red, with arrows at contacts",
    )
    parser.add_argument("--collisions", action="store_true", help="show the collision shapes")
    parser.add_argument(
        "--decomposed", action="store_true", help="for both, use the hulls of kineverse decompose"
    )
    parser.add_argument("--degrees", action="store_true", help="show angles in degrees")
    parser.add_argument(
        "--picture",
        metavar="PATH",
        help="write a picture (.png) or a clip (.webp, .gif) instead of opening a page",
    )
    playback = parser.add_argument_group("recordings and trajectories")
    playback.add_argument("--play", metavar="FILE", help="play a trajectory of kineverse plan --save")
    playback.add_argument(
        "--time", type=float, metavar="S", help="show this time [s] instead of playing (--picture: the end)"
    )
    playback.add_argument("--speed", type=float, default=1.0, metavar="X", help="play X times as fast (1)")
    playback.add_argument("--loop", action="store_true", help="play again and again")
    playback.add_argument("--plot", metavar="PATH", help="write plots of a recording (.png, .svg)")
    add_model_options(parser)
    add_page_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until interrupted."""
    assigned = parse_assignments(arguments.assignments)
    near = None if arguments.near is None else parse_length(arguments.near)
    if arguments.model is None:
        if arguments.picture is not None:
            raise InvalidValueError("--picture needs a MODEL to draw; 'kineverse view' alone lists them")
        return print_models()
    if is_gallery_list(arguments.model):
        return print_articulations()

    extras = {
        "geometry": near is not None or arguments.decomposed,
        "figures": arguments.plot is not None,
        "mjcf": needs_mujoco(arguments.model),
        "view": arguments.plot is None and (arguments.picture is None or is_clip_name(arguments.picture)),
    }
    require("kineverse view", extras)
    check_picture_path(arguments.picture, clips=True)
    _check_clip(arguments)
    from kineverse.view.page import read_title  # for start-up time

    label = read_title(arguments.model)
    recording = _read_recording(arguments)
    if recording is not None:
        model: ModelView = recording.model
    else:
        model = loaded = load_model(arguments, arguments.model, follow=arguments.robot is None)
        if arguments.robot is not None:
            _, standing = include_robot(arguments, loaded)
            assigned = {str(s): v for s, v in standing.items()} | assigned
            label = f"{label}, {read_title(arguments.robot.rpartition('@')[0] or arguments.robot)}"
    trajectory = _read_trajectory(arguments, model)
    if arguments.plot is not None:
        return _write_plot(arguments, recording)
    motion = recording or trajectory
    if motion is not None and arguments.time is not None and arguments.time > motion.duration:
        print_notes([f"--time {arguments.time:g}: it ends at {motion.duration:.4g} s, which is shown"])
    if assigned:
        print_notes(find_limit_notes(model, complete(model, assigned), arguments.assignments))
    for mesh in show_progress(meshes.list_visual_meshes(model), "reading meshes", "file"):
        meshes.load_mesh(mesh)  # cached for the drawing
    if arguments.picture is not None:
        if is_clip_name(arguments.picture):
            return _write_clip(arguments, model, assigned, motion)
        return _write_picture(arguments, model, assigned, near, motion)
    from kineverse.view.viewer import Viewer  # for start-up time

    options = {"label": label, "degrees": arguments.degrees, **page_options(arguments)}
    with handle_interrupts(), Viewer(model, assigned, **options) as page, ExitStack() as stack:
        if near is not None:
            page.collisions.show_near(near)
        if arguments.decomposed:
            page.collisions.show_decomposed()
        if arguments.collisions:
            page.collisions.show_shapes()
        print_mesh_problems(page.problems)
        if page.unplaced:
            print_notes([f"not finite at this state, and hidden: {', '.join(page.unplaced)}"])
        speed = {"speed": arguments.speed, "loop": arguments.loop}
        if recording is not None:
            from kineverse.view.run_overlay import play_recording  # for start-up time

            play_recording(page, recording, time=arguments.time, **speed)
        elif trajectory is not None:
            page.play(trajectory, at=arguments.time, **speed)
        if find_scheme(arguments.model) is not None:
            _show_streams(stack, page, model)
        print_address(page, browser=not arguments.no_browser)
        print(recording or model, flush=True)
        page.wait()
    return 0


def _show_streams(stack: ExitStack, page: Viewer, model: ModelView) -> None:
    """Show the streams beside a model that a server keeps, unless it is shown as a copy."""
    from kineverse.exchange import LiveModel  # for start-up time
    from kineverse.live import LivePage  # for start-up time

    if isinstance(model, LiveModel):
        # Whoever controls the robot comes first; threads that are there answer the emergency stop.
        os.nice(_NICENESS)
        stack.enter_context(LivePage(page, model))


def _read_recording(arguments: argparse.Namespace) -> RunRecording | None:
    """Return the recording that is to be shown; None for a model."""
    name = arguments.model.lower()
    moves = arguments.play is not None or name.endswith(".mcap")
    if (arguments.time is not None or arguments.speed != 1.0 or arguments.loop) and not moves:
        raise InvalidValueError("--time, --speed and --loop are for recordings (.mcap) and --play")
    if arguments.time is not None and not 0.0 <= arguments.time < math.inf:
        raise InvalidValueError(f"--time is a time from 0 s, not {arguments.time}")
    if name.endswith(".json") and not name.endswith(".kv.json") and Path(arguments.model).is_file():
        raise InvalidValueError(
            f"{arguments.model} is no model. Try: kineverse view MODEL --play {arguments.model}"
        )
    if not name.endswith(".mcap"):
        return None

    for option in ("play", "robot", "assignments"):
        if getattr(arguments, option):
            name = "--set" if option == "assignments" else f"--{option}"
            raise InvalidValueError(f"{name} is for a model; a recording has its own motion")
    recording = read_run_recording(arguments.model, root=arguments.root)
    if not recording.complete:
        print_notes([f"{arguments.model} was cut, and ends at {recording.duration:.4g} s"])
    return recording


def _read_trajectory(arguments: argparse.Namespace, model: ModelView) -> Trajectory | None:
    if arguments.play is None:
        return None

    trajectory = Trajectory.load(arguments.play)
    complete(model, dict(trajectory.at(0.0)))  # raises for coordinates that the model does not have
    return trajectory


def _write_plot(arguments: argparse.Namespace, recording: RunRecording | None) -> int:
    if recording is None:
        raise InvalidValueError("--plot is for recordings (.mcap); a model does not change over time")
    from kineverse.view.plots import Figure  # for start-up time
    from kineverse.worlds.recording_plot import plot_recording  # for start-up time

    Figure(lambda canvas: plot_recording(recording, canvas), (11.0, 7.0)).save(Path(arguments.plot))
    print(f"plot: {arguments.plot}")
    return 0


def _check_clip(arguments: argparse.Namespace) -> None:
    """Raise if a clip is wanted of what only a picture shows."""
    if arguments.picture is None or not is_clip_name(arguments.picture):
        return
    for option in ("near", "time"):
        if getattr(arguments, option) is not None:
            raise InvalidValueError(f"--{option} is for a picture of one moment (.png), and a clip is none.")


def _write_clip(
    arguments: argparse.Namespace,
    model: ModelView,
    state: dict[str, float],
    motion: RunRecording | Trajectory | None,
) -> int:
    if motion is None:
        moments = sweep_ranges(model, state, held=state)
        if not moments:
            raise InvalidValueError("Nothing moves that --set does not hold; a picture (.png) shows as much.")
    else:
        moments = _list_moments(motion, state, clip_times(motion.duration, arguments.speed))
    drawn = draw_clip(model, moments, collisions=arguments.collisions, decomposed=arguments.decomposed)
    pictures = [one for one, _ in zip(drawn, show_progress(moments, "drawing", "picture"), strict=True)]
    write_clip(arguments.picture, pictures)
    print_mesh_problems(list_mesh_problems(model))
    print(f"clip: {arguments.picture}")
    return 0


def _list_moments(
    motion: RunRecording | Trajectory, state: dict[str, float], times: list[float]
) -> list[ClipMoment]:
    """Return what a clip shows of a recording or of a trajectory at some times [s]."""
    if isinstance(motion, Trajectory):
        return [ClipMoment(state | {str(s): v for s, v in motion.at(time).items()}) for time in times]
    from kineverse.view.run_overlay import RecordedScene  # for start-up time

    scene = RecordedScene(motion)
    moments = []
    for time in times:
        shown = scene.at(time)
        ghosts, arrows = scene.drawing.draw_ghosts(shown), scene.drawing.draw_arrows(shown)
        moments.append(ClipMoment(scene.values_at(time), ghosts, arrows))
    return moments


def _write_picture(
    arguments: argparse.Namespace,
    model: ModelView,
    state: dict[str, float],
    near: float | None,
    motion: RunRecording | Trajectory | None,
) -> int:
    from kineverse.view.run_overlay import RecordedScene  # for start-up time

    options: dict[str, Any] = {"collisions": arguments.collisions, "decomposed": arguments.decomposed}
    if motion is not None:
        time = motion.duration if arguments.time is None else arguments.time
        if isinstance(motion, RunRecording):
            scene = RecordedScene(motion)
            state, moment = scene.values_at(time), scene.at(time)
            options["overlay"] = scene.drawing.draw_ghosts(moment)
            options["over"] = scene.drawing.draw_arrows(moment)
        else:
            state = state | {str(s): v for s, v in motion.at(time).items()}
    save_picture(arguments.picture, model, state, near=near, **options)
    print_mesh_problems(list_mesh_problems(model))
    left_out = label_unusable_shapes(model, find_unusable_shapes(model)) if near is not None else {}
    if left_out:
        print_notes([f"no distances to {', '.join(left_out)}"])
    print(f"picture: {arguments.picture}")
    return 0
