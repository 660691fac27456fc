"""``kineverse decompose``: meshes as unions of convex hulls."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kineverse._names import match_names, matches_pattern
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError
from kineverse.expressions.printing import format_number
from kineverse.geometry.decomposition import (
    DecompositionSettings,
    ResourceLimits,
    clear,
    decompose_all,
    folder,
    list_entries,
)
from kineverse.model.body import Mesh

from .arguments import (
    add_cache_options,
    add_model_options,
    load_model,
    manage_cache,
    needs_mujoco,
    parse_length,
    require,
)
from .output import colorize, format_cells, join_lines, show_activity, show_progress

if TYPE_CHECKING:
    from kineverse.geometry.decomposition import CacheEntry, Decomposition, DecompositionOutcome

HELP = """\
Of a model, the meshes of collision shapes are decomposed; of bodies without collision shapes, the visual
meshes. The hulls are stored in the user's cache by the content of the mesh and the settings; cached meshes
are not decomposed again. Each mesh takes seconds to minutes; after Ctrl-C, finished meshes stay cached.

"excess" is the largest distance of the hulls from the mesh, "uncovered" that of the mesh from the hulls. Both
are taken over some thousand sampled points, so that the true values may be a little larger.

The exit status is 0 if all went well, 1 if a mesh could not be decomposed, 2 if a model could not be read.

examples:
  kineverse decompose robot.urdf
  kineverse decompose mug.stl plate.obj --error 2mm
  kineverse decompose robot.urdf --links gripper_finger palm --max-hulls 8 --force
  kineverse decompose --list"""

ENDINGS = (".stl", ".obj", ".dae", ".ply", ".off", ".glb")  # suffixes of mesh files

WRONG_MESH, WRONG_MODEL = 1, 2


@dataclass
class MeshTask:
    """Mesh to decompose, with the links that it belongs to; a mesh file has none."""

    mesh: Mesh
    links: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Label in a table: the first link, the number of others, and the name of the file."""
        file = Path(self.mesh.uri).name
        if not self.links:
            return file
        more = f" and {len(self.links) - 1} more" if len(self.links) > 1 else ""
        return f"{self.links[0]}{more}: {file}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "names", metavar="MODEL_OR_MESH", nargs="*", help="name or path of a model, or a mesh file"
    )
    add_model_options(parser)
    parser.add_argument(
        "--links", metavar="LINK", nargs="+", help="only the meshes of these links (or patterns)"
    )
    parser.add_argument("--max-hulls", metavar="N", type=int, help="largest number of hulls of a mesh (32)")
    parser.add_argument(
        "--error",
        metavar="M",
        help="largest distance of hulls from the mesh: 0.002, 2mm (2%% of the mesh's longest edge)",
    )
    parser.add_argument(
        "--jobs", metavar="N", type=int, help="meshes decomposed in parallel (one for each core)"
    )
    parser.add_argument("--timeout", metavar="S", type=float, help="time limit of a mesh [s] (600)")
    parser.add_argument("--memory", metavar="GIB", type=float, help="memory limit of a mesh [GiB] (4)")
    add_cache_options(parser, "decompose cached meshes again")


def run(arguments: argparse.Namespace) -> int:
    """Decompose the meshes, print the results, and return the worst status."""
    if arguments.list or arguments.clear:
        return _manage_cache(arguments)
    if not arguments.names:
        raise UnknownNameError("Name a model or a mesh file; see kineverse decompose --help.")
    require("kineverse decompose", {"decomposition": True, "mjcf": any(map(needs_mujoco, arguments.names))})

    settings, limits, jobs = _settings(arguments)
    tasks, unread = _tasks(arguments)
    order = {task.mesh: k for k, task in enumerate(tasks)}
    outcomes = decompose_all([task.mesh for task in tasks], settings, limits, arguments.force, jobs)
    shown = show_progress(outcomes, "decomposing", "mesh", len(tasks))
    results = sorted(shown, key=lambda outcome: order[outcome.mesh])
    status = WRONG_MODEL if unread else WRONG_MESH if any(o.error for o in results) else 0
    if arguments.json:
        meshes = [_outcome_to_json(task, outcome) for task, outcome in zip(tasks, results, strict=True)]
        answer = {"status": status, "meshes": meshes, "not_read": unread}
        print(json.dumps(answer, allow_nan=False))
    else:
        print("\n\n".join(_format_results(tasks, results, unread)))
    return status


def _settings(arguments: argparse.Namespace) -> tuple[Any, Any, int]:
    options: dict[str, Any] = {} if arguments.max_hulls is None else {"max_hulls": arguments.max_hulls}
    if arguments.error is not None:
        options["error"] = parse_length(arguments.error)
    limits: dict[str, Any] = {}
    if arguments.timeout is not None:
        limits["seconds"] = _positive(arguments.timeout, "--timeout")
    if arguments.memory is not None:
        limits["memory"] = int(_positive(arguments.memory, "--memory") * 2**30)
    jobs = (os.cpu_count() or 1) if arguments.jobs is None else int(_positive(arguments.jobs, "--jobs"))
    return DecompositionSettings(**options), ResourceLimits(**limits), jobs


def _positive(value: float, option: str) -> float:
    if not 0.0 < value < 1e6:
        raise InvalidValueError(f"{option} {value:g}: write a positive number.")
    return value


def _tasks(arguments: argparse.Namespace) -> tuple[list[MeshTask], dict[str, str]]:
    """Return a task for each distinct mesh, and by name the reasons of models that cannot be read."""
    tasks: dict[Mesh, MeshTask] = {}
    unread: dict[str, str] = {}
    with_meshes: set[str] = set()
    links: Sequence[str] | None = arguments.links
    for name in arguments.names:
        if name.lower().endswith(ENDINGS):
            mesh = Mesh(os.path.abspath(name))
            tasks.setdefault(mesh, MeshTask(mesh))
            continue
        try:
            meshes = _model_meshes(name, arguments)
        except (KineverseError, OSError) as error:
            unread[name] = join_lines(error)
            continue
        for link, mesh in meshes:
            with_meshes.add(link)
            if links is None or matches_pattern(link, links):
                task = tasks.setdefault(mesh, MeshTask(mesh))
                task.links += [] if link in task.links else [link]
    if not unread:
        # Otherwise the link may belong to a model that cannot be read.
        match_names(links or (), sorted(with_meshes), "link with a mesh", "--links")
    return list(tasks.values()), unread


def _model_meshes(name: str, arguments: argparse.Namespace) -> list[tuple[str, Mesh]]:
    with show_activity(f"reading {name}"):
        model = load_model(arguments, name)
    return [
        (link, shape.geometry)
        for link, body in model.bodies.items()
        for shape in body.collisions or body.visuals
        if isinstance(shape.geometry, Mesh)
    ]


def _format_results(
    tasks: Sequence[MeshTask], outcomes: Sequence[DecompositionOutcome], unread: dict[str, str]
) -> list[str]:
    rows = []
    remarks, errors = ["remarks"], [colorize("not decomposed", "!")]
    for task, outcome in zip(tasks, outcomes, strict=True):
        decomposition = outcome.decomposition
        if decomposition is None:
            errors.append(f"  {task.name}: {join_lines(outcome.error)}")
            continue
        time_ = "cached" if outcome.cached else f"{decomposition.seconds:.1f} s"
        rows.append((task.name, *_format_row(decomposition), time_))
        remarks += [f"  {task.name}: {remark}" for remark in decomposition.remarks]
    sections = [format_cells(("mesh", *HEAD, "time"), rows)] if rows else []
    failed = [colorize("cannot be read", "!"), *(f"  {name}: {reason}" for name, reason in unread.items())]
    sections += ["\n".join(lines) for lines in (remarks, errors, failed) if len(lines) > 1]
    return sections or ["There are no meshes."]


HEAD = ("hulls", "mesh [l]", "hulls [l]", "one hull [l]", "error [mm]", "excess [mm]", "uncovered [mm]")


def _format_row(decomposition: Decomposition) -> tuple[str, ...]:
    a = decomposition.accuracy
    volumes, lengths = (a.mesh_volume, a.volume, a.hull_volume), (decomposition.error, a.excess, a.uncovered)
    litres = ("open" if volume is None else format_number(1e3 * volume) for volume in volumes)
    return (str(len(decomposition.hulls)), *litres, *(format_number(1e3 * length, 3) for length in lengths))


def _decomposition_to_json(decomposition: Decomposition) -> dict[str, Any]:
    return {
        "file": decomposition.name,
        "hulls": len(decomposition.hulls),
        "corners": sum(len(hull) for hull in decomposition.hulls),
        "error": decomposition.error,
        "max_hulls": decomposition.max_hulls,
        **asdict(decomposition.accuracy),
        "seconds": decomposition.seconds,
        "remarks": list(decomposition.remarks),
    }


def _outcome_to_json(task: MeshTask, outcome: DecompositionOutcome) -> dict[str, Any]:
    decomposition = outcome.decomposition
    facts = {"file": task.mesh.uri} if decomposition is None else _decomposition_to_json(decomposition)
    return {
        **facts,
        "links": task.links,
        "scale": list(task.mesh.scale),
        "cached": outcome.cached,
        "failure": None if outcome.error is None else join_lines(outcome.error),
    }


def _manage_cache(arguments: argparse.Namespace) -> int:
    def describe(entry: CacheEntry) -> tuple[dict[str, Any], tuple[str, ...]]:
        made = entry.decomposition.made
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(made))
        facts = {**_decomposition_to_json(entry.decomposition), "made": made, "bytes": entry.bytes}
        return facts, (Path(entry.decomposition.name).name, *_format_row(entry.decomposition), when)

    head, entries = ("mesh", *HEAD, "made"), [*map(describe, list_entries())]
    return manage_cache(arguments, arguments.names, "decompositions", folder(), clear, head, entries)
