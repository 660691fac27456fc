"""Observed frames whose poses were exchanged.

Two frames with each other's poses contradict the model, and other joints would explain them. If each joint
fits as served after the poses are exchanged back, the labels are wrong rather than the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from kineverse.estimation.identification.observations import PoseTrack, pair_tracks
from kineverse.estimation.robust import CHI_SQUARED_6

from .known_motion import KnownJoint
from .known_residuals import compute_residuals
from .testability import TestableJoint

# Number of observations that are compared.
_COMPARED = 50


def find_exchanged_frames(
    implausible_since: Mapping[TestableJoint, int],
    served_joints: Mapping[TestableJoint, KnownJoint],
    tracks: Mapping[str, PoseTrack],
    exact: str | None,
    first: int = 0,
) -> dict[TestableJoint, str]:
    """Return the joints that fit after two frames are exchanged, with that as the reason."""
    known = [joint for joint in served_joints if {joint.parent, joint.child} <= tracks.keys()]
    frames = dict.fromkeys(
        f for joint in known if joint in implausible_since for f in (joint.parent, joint.child) if f != exact
    )
    since = min(implausible_since.values(), default=0) - first
    for a, b in combinations(frames, 2):
        exchanged = {**tracks, a: tracks[b], b: tracks[a]}
        involved = [joint for joint in known if {joint.parent, joint.child} & {a, b}]
        if any(_fits(served_joints[joint], tracks, joint, since) for joint in involved):
            continue
        if all(_fits(served_joints[joint], exchanged, joint, since) for joint in involved):
            reason = f"the poses of '{a}' and '{b}' seem to be exchanged: with each other's the joint fits"
            return dict.fromkeys([joint for joint in involved if joint in implausible_since], reason)
    return {}


def _fits(served: KnownJoint, tracks: Mapping[str, PoseTrack], joint: TestableJoint, since: int) -> bool:
    """Return True if a joint explains most observations from one on."""
    parent, child = tracks[joint.parent], tracks[joint.child]
    seen = np.flatnonzero(parent.seen & child.seen)
    seen = seen[seen >= since][:_COMPARED]
    if not len(seen):
        return False
    residuals = compute_residuals(served, pair_tracks(parent, child, seen))
    return float(np.median(np.sum(residuals.orthogonal**2, axis=1))) < CHI_SQUARED_6
