"""Fingers in a kinematic tree: small branches that joints move on one rigid link."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from msgspec import Struct

from kineverse.formats.srdf.description import Srdf
from kineverse.model.frame import WORLD, is_of_robot
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .hand_model import bodies_with_shapes

MOST_JOINTS = 3  # most free coordinates of one finger


class Branch(Struct, frozen=True):
    """Part of a kinematic tree that a joint moves on a rigid link."""

    root: str  # frame that moves in its parent
    frames: tuple[str, ...]  # all frames from there on, parents first
    joints: tuple[Symbol, ...]  # free coordinates that move their bodies on the link, sorted


class Palm(Struct, frozen=True):
    """Rigid link with branches that may be fingers."""

    root: str  # frame of the link that moves in its parent, or stands in the world
    frames: tuple[str, ...]  # its frames, parents first
    branches: tuple[Branch, ...]
    refused: tuple[str, ...]  # why each other branch on it is no finger


def find_palms(model: ModelView, robot: str, srdf: Srdf | None = None) -> list[tuple[int, Palm]]:
    """Return the rigid links of a robot with two or more moving branches.

    With each comes the index of the first end effector of a semantic description whose links it carries.
    """
    parents = {name: frame.parent for name, frame in model.frames.items() if is_of_robot(name, robot)}
    moving = {f: model.speeds_of(f, parent) for f, parent in parents.items()}
    link: dict[str, str] = {}
    for frame in _parents_first(parents):
        parent = parents[frame]
        # The robot's root and the world are one rigid link for no robot: nothing grasps with the ground.
        link[frame] = frame if moving[frame] or parent not in link else link[parent]
    children: dict[str, list[str]] = {}
    for frame in link:
        if link[frame] == frame and parents[frame] in link:
            children.setdefault(link[parents[frame]], []).append(frame)
    palms = []
    for root, roots in children.items():
        branches = [_branch(model, frame, parents) for frame in roots]
        why = [_why_no_finger(model, branch) for branch in branches]
        if len(branches) > 1:
            fingers = tuple(branch for branch, reason in zip(branches, why, strict=True) if not reason)
            frames = tuple(f for f in link if link[f] == root)
            palm = Palm(root, frames, fingers, tuple(filter(None, why)))
            palms.append((_srdf_rank(palm, srdf), palm))
    return palms


def _parents_first(parents: Mapping[str, str]) -> Iterable[str]:
    done: dict[str, None] = {}
    for frame in parents:
        path = []
        while frame in parents and frame not in done:
            path.append(frame)
            frame = parents[frame]
        done.update(dict.fromkeys(reversed(path)))
    return done


def _branch(model: ModelView, root: str, parents: Mapping[str, str]) -> Branch:
    frames = {root: None}
    for frame in _parents_first(parents):
        if parents[frame] in frames:
            frames[frame] = None
    shaped = bodies_with_shapes(model, frames) or frames
    speeds = {s for f in shaped for s in model.speeds_of(f, parents[root])}
    return Branch(root, tuple(frames), tuple(sorted((s.position for s in speeds), key=str)))


def _why_no_finger(model: ModelView, branch: Branch) -> str:
    """Return the reason why a branch is no finger; empty if it may be one."""
    if len(branch.joints) > MOST_JOINTS:
        return f"{branch.root} has {len(branch.joints)} joints, more than a finger's {MOST_JOINTS}"
    names = ", ".join(map(str, branch.joints))
    if not all(high - low <= 2 * math.pi for low, high in map(model.limits, branch.joints)):
        return f"{branch.root} has no limits ({names})"
    if not bodies_with_shapes(model, branch.frames):
        return f"{branch.root} has no shapes ({names})"
    return ""


def _srdf_rank(palm: Palm, srdf: Srdf | None) -> int:
    """Return the index of the first end effector whose links the palm carries."""
    carried = {f for b in palm.branches for f in b.frames}
    effectors = [] if srdf is None else list(srdf.end_effectors.values())
    for k, effector in enumerate(effectors):
        group = srdf.groups.get(effector.group) if srdf else None
        if group is not None and carried & set(group.links):
            return k
    return len(effectors)


def hand_frame(model: ModelView, branches: Iterable[Branch]) -> str:
    """Return the lowest frame that carries all branches: their common parent."""
    paths = [path_to_root(model, model.frames[branch.root].parent) for branch in branches]
    shared = set(paths[0]).intersection(*paths[1:])
    return next(frame for frame in paths[0] if frame in shared)


def path_to_root(model: ModelView, frame: str) -> list[str]:
    """Return a frame and all frames above it, without the world."""
    path = []
    while frame != WORLD:
        path.append(frame)
        frame = model.frames[frame].parent
    return path
