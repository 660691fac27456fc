"""Grippers of a robot: two opposed fingers on a hand, found from the SRDF or from the joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from kineverse import lie
from kineverse.errors import UnknownNameError
from kineverse.formats.srdf.description import Srdf
from kineverse.lie import Array
from kineverse.model.body import Body, Shape, Sphere
from kineverse.model.model_view import ModelView
from kineverse.model.symbolic_view import cached_for_version
from kineverse.symbols import Symbol

from .finger_branches import Branch, Palm, find_palms, hand_frame, path_to_root
from .fingertip_geometry import Pads, find_pads, reaches_pads
from .hand_model import HandModel, bodies_with_shapes, usable_bodies

_TYPICAL = 0.015  # thickness of a bar for which the grasp pose is given [m]


@dataclass(frozen=True, slots=True, eq=False)
class Gripper:
    """Two opposed fingers on a hand.

    Attributes
    ----------
    robot
        Prefix of the robot in the model.
    hand
        Frame that carries the fingers.
    grasp_pose
        Pose hand_T_grasp (4, 4) [m]: its origin lies between the finger pads around a thin bar, x points out
        of the hand, y along the closing motion, from the first finger to the second.
    fingers
        Frames of the one finger, and of the other, that have shapes.
    bodies
        Frames of the hand and all fingers that have shapes: the group that may touch what is grasped.
    joints
        Free coordinates that open and close the fingers.
    opened, closed
        Values of these coordinates for open fingers, and for fingers that touch or do not close further [m],
        [rad].
    width
        Gap between the open fingers [m].
    pads
        The facing surfaces.
    remarks
        Shapes that cannot be read, and why. Without any shape, a finger is where its frames are: then the
        width and the grasp pose are rough.

    See Also
    --------
    kineverse.grasping.find_gripper
    """

    robot: str
    hand: str
    grasp_pose: Array
    fingers: tuple[tuple[str, ...], tuple[str, ...]]
    bodies: tuple[str, ...]
    joints: tuple[Symbol, ...]
    opened: Mapping[Symbol, float]
    closed: Mapping[Symbol, float]
    width: float
    pads: Pads = field(repr=False)
    remarks: tuple[str, ...] = ()

    def values_at(self, gap: float) -> dict[Symbol, float]:
        """Return the values of the joints at which the pads have a gap [m], within what they can."""
        return self.pads.values_at(gap)

    def grasp_pose_at(self, gap: float) -> Array:
        """Return hand_T_grasp (4, 4) [m] for pads with a gap [m]: fingers that turn move the pads along x."""
        pose = self.grasp_pose.copy()
        pose[:3, 3] = self.pads.middle_at(gap)
        return pose

    def __str__(self) -> str:
        joints = ", ".join(f"{s} from {self.opened[s]:.4g} to {self.closed[s]:.4g}" for s in self.joints)
        missing = f"; {len(self.remarks)} shapes are missing" if self.remarks else ""
        return f"gripper of {self.hand}, opens {self.width * 1e3:.0f} mm by {joints}{missing}"


def find_grippers(model: ModelView, robot: str, srdf: Srdf | None = None) -> tuple[Gripper, ...]:
    """Return the grippers of a robot, the likeliest for manipulation first; empty if it has none.

    Grippers of the end effectors of a semantic description come first, then the wider ones. Of equally wide
    ones, that further to the right comes first.

    Parameters
    ----------
    model
        Model that contains the robot.
    robot
        Prefix of the robot in the model; empty for a model without prefix.
    srdf
        Semantic description, whose end effectors come first.

    Examples
    --------
    >>> [gripper.hand for gripper in kv.grasping.find_grippers(kv.load("pr2"), "pr2")]
    ['pr2/r_gripper_palm_link', 'pr2/l_gripper_palm_link']
    """
    return _search(model, robot, srdf)[0]


def find_gripper(model: ModelView, robot: str, hand: str | None = None, srdf: Srdf | None = None) -> Gripper:
    """Return the gripper of a robot, the one of a hand if there is a name.

    Parameters
    ----------
    model, robot, srdf
        As for :func:`find_grippers`.
    hand
        Frame of the hand, or one of its fingers.

    Raises
    ------
    UnknownNameError
        If the robot has no gripper, or none at this frame; the message lists the grippers.

    Examples
    --------
    >>> gripper = kv.grasping.find_gripper(kv.load("fetch"), "fetch")
    >>> gripper.hand, round(gripper.width, 3)
    ('fetch/gripper_link', 0.102)
    """
    result, why = _search(model, robot, srdf)
    name = f"The robot '{robot}'" if robot else "The model"
    if not result:
        if hand is not None:
            model.fk(hand)  # raises for an unknown frame
        # Hands come last in a tree, and first in the message.
        lines = [f"\n  {line}" for line in why[: -_MOST_LINKS - 1 : -1]]
        lines += [f"\n  Further links without fingers: {len(why) - _MOST_LINKS}."] * (len(why) > _MOST_LINKS)
        reasons = "".join(lines) or " None of its links carries two moving branches."
        raise UnknownNameError(f"{name} has no gripper with two opposed fingers.{reasons}")
    if hand is None:
        return result[0]
    for gripper in result:
        near = hand in model.frames and not model.speeds_of(hand, gripper.hand)
        if hand in (gripper.hand, *gripper.bodies) or near:
            return gripper
    listed = ", ".join(repr(gripper.hand) for gripper in result)
    raise UnknownNameError(f"{name} has no gripper at '{hand}'. Its grippers are at: {listed}.")


def _search(model: ModelView, robot: str, srdf: Srdf | None) -> tuple[tuple[Gripper, ...], list[str]]:
    """Return the grippers, and for each link without one the reason; kept for a version of the model."""
    key = "grippers", robot, id(srdf)
    _, result = cached_for_version(
        model, key, lambda: (srdf, _search_anew(model, robot, srdf))
    )  # with the description, so that no other one gets its id
    return result


def _search_anew(model: ModelView, robot: str, srdf: Srdf | None) -> tuple[tuple[Gripper, ...], list[str]]:
    result: list[tuple[tuple[float, ...], Gripper]] = []
    why: list[str] = []
    for rank, palm in find_palms(model, robot, srdf):
        reasons = list(palm.refused)
        if len(palm.branches) > 1:
            gripper = _best_pair(model, robot, palm, reasons)
            if gripper is not None:
                # The hand at the default state, as the robot sees it: y points to the left.
                place = np.asarray(model.fk(gripper.hand)(model.default_state()))[:3, 3]
                result.append(((rank, -round(gripper.width, 4), round(float(place[1]), 4)), gripper))
                continue
        more = [f"and {len(reasons) - _MOST_LISTED} more"] if len(reasons) > _MOST_LISTED else []
        why.append(f"At {palm.root}: {'; '.join(reasons[:_MOST_LISTED] + more)}.")
    result.sort(key=lambda entry: entry[0])
    return tuple(gripper for _, gripper in result), why


def _best_pair(model: ModelView, robot: str, palm: Palm, reasons: list[str]) -> Gripper | None:
    """Return the gripper on a link whose pads are farthest out; else add why there is none to the reasons."""
    hand = hand_frame(model, palm.branches)
    joints = tuple(dict.fromkeys(s for b in palm.branches for s in b.joints))
    below = [f for f in palm.frames if hand in path_to_root(model, f)]
    moving = [f for b in palm.branches for f in b.frames]
    bodies = bodies_with_shapes(model, [*below, *moving])
    usable, problems = usable_bodies(bodies)
    for branch in palm.branches:
        if not any(f in usable for f in branch.frames):
            usable.update(dict.fromkeys(branch.frames, _STAND_IN))
    alone = HandModel(model, hand, usable, joints)
    root = np.asarray(model.fk(palm.root, hand)({}))[:3, 3]
    branches = []
    for branch in palm.branches:
        size = np.linalg.norm(np.ptp(alone.box_corners(f for f in branch.frames if f in usable), axis=0))
        if size < _LARGEST:
            branches.append(branch)
        else:
            names = ", ".join(map(str, branch.joints))
            reasons.append(f"{branch.root} is {size:.2g} m large, more than a finger ({names})")
    best: tuple[Pads, Branch, Branch] | None = None
    for k, a in enumerate(branches):
        for b in branches[k + 1 :]:
            pads, reason = find_pads(model, alone, a, b, root)
            if pads is None:
                names = ", ".join(map(str, dict.fromkeys((*a.joints, *b.joints))))
                reasons.append(f"{a.root} and {b.root}: {reason} ({names})")
            elif best is None or _reach(pads) > _reach(best[0]) + 1e-6:
                best = pads, a, b
    if best is None:
        if len(branches) > 2:
            reasons.insert(0, f"{len(branches)} branches, of which no two are opposed fingers")
        return None
    pads, *pair = best
    for branch in palm.branches:
        if branch not in pair and reaches_pads(alone, branch, pads):
            names = ", ".join(b.root for b in (*pair, branch))
            reasons.append(f"{names} are three fingers, and grasps are sampled for two")
            return None
    width = float(pads.stroke[0, 1])
    pose = lie.transform(pads.axes, pads.middle_at(min(_TYPICAL, width / 2)))
    return Gripper(
        robot=robot,
        hand=hand,
        grasp_pose=pose,
        fingers=pads.fingers,
        bodies=tuple(bodies),
        joints=tuple(pads.opened),
        opened=pads.opened,
        closed=pads.closed,
        width=width,
        pads=pads,
        remarks=tuple(problems),
    )


_MOST_LINKS, _MOST_LISTED = 2, 2  # links that a message names, and reasons for each
_LARGEST = 0.5  # diagonal of the box around a finger that is too large for one [m]
_STAND_IN = Body(collisions=(Shape(Sphere(5e-4)),))  # for shapes that cannot be read


def _reach(pads: Pads) -> float:
    return float(pads.middle_at(_TYPICAL) @ pads.axes[:, 0])
