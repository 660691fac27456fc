"""The recordings of Sturm, Stachniss and Burgard (2011), and what each of them shows.

Handles and markers of doors and drawers, moved by hand or by a robot. They belong to others and do not come
with this package; folders and files are named as in the repository ``tum-vision/articulation``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from kineverse.errors import FormatError
from kineverse.estimation.noise import pose_covariance
from kineverse.estimation.recordings import read_recording
from kineverse.lie import Array

Label = Literal["revolute", "prismatic"]

FOLDER = "sturm_tracks"
SOURCE = "https://github.com/tum-vision/articulation"

LABELS: Mapping[str, Label] = MappingProxyType(
    {
        "cabinet_one/*.log": "revolute",
        "drawer_one/*.log": "prismatic",
        "kitchen_6d/M2U00389.log": "revolute",
        "kitchen_6d/M2U00390.log": "revolute",
        "kitchen_6d/M2U00391.log": "revolute",
        "kitchen_6d/M2U00393.log": "revolute",
        "kitchen_6d/M2U00394.log": "prismatic",
        "kitchen_6d/M2U00395.log": "prismatic",
        "kitchen_6d/M2U00406.log": "revolute",
        "kitchen_6d/M2U00411.log": "revolute",
        "mechanisms_iros_2010/dishwasher/*.log": "revolute",
        "mechanisms_iros_2010/drawer/*.log": "prismatic",
        "mechanisms_iros_2010/left_door/*.log": "revolute",
        "mechanisms_iros_2010/right_door/*.log": "revolute",
        "microwave/*.log": "revolute",
        "models_data/door.txt": "revolute",
    }
)
"""Objects by the names of their files."""

COLUMNS: Mapping[str, str] = MappingProxyType({"models_data/door.txt": "x,y,z,qx,qy,qz,qw,-,-"})
"""Columns of the pose in files that have more."""

POSITION, ORIENTATION = 0.01, math.radians(5.0)
"""Deviation of tracked poses from an ideal joint, in each coordinate [m] and about each axis [rad].

That is not the jitter of a sensor, a millimetre and less: hands slip, handles and hinges give way, and planar
markers are seen tilted.
"""

THINNED = 20
"""Number of poses taken of a recording, evenly over time: neighbouring ones share most of their errors."""


@dataclass(frozen=True, eq=False)
class LabelledRecording:
    """A recording and its label.

    Attributes
    ----------
    name
        The file in its folder, without its suffix.
    label
        What it is a recording of.
    poses
        (N, 4, 4) of a marker, or positions (N, 3) of a handle, in the camera's frame [m].
    """

    name: str
    label: Label
    poses: Array

    @property
    def covariance(self) -> Array:
        """Of each pose (6, 6) or position (3, 3), the same for all recordings."""
        whole = pose_covariance(POSITION, ORIENTATION)
        return whole if self.poses.ndim == 3 else whole[:3, :3]


def read_labelled_recordings(folder: Path | None) -> Iterator[LabelledRecording]:
    """Return the recordings in a folder, sorted by name.

    Parameters
    ----------
    folder
        The one with ``cabinet_one`` and the others; None for ``sturm_tracks`` in the current one.

    Raises
    ------
    FormatError
        If there is no such folder, none of the recordings is in it, or one cannot be read.
    """
    place = Path(FOLDER) if folder is None else folder
    found = sorted((file, label) for pattern, label in LABELS.items() for file in place.glob(pattern))
    if not found:
        what = "none of them is there" if place.is_dir() else "there is no such folder"
        raise FormatError(
            f"{place}: {what}. This experiment is about recordings of doors and drawers, cabinet_one/001.log "
            f"and so on, from {SOURCE}. Say where they are: --data FOLDER."
        )
    return (_read_labelled(file, file.relative_to(place), label) for file, label in found)


def _read_labelled(file: Path, name: Path, label: Label) -> LabelledRecording:
    recording = read_recording(file, COLUMNS.get(name.as_posix()))
    poses = recording.pair().thin(THINNED).child_poses
    return LabelledRecording(name.with_suffix("").as_posix(), label, poses)
