"""Recordings of Sturm, Stachniss and Burgard (2011) with their labels.

They contain handles and markers of doors and drawers, moved by hand or by a robot. They are not part of this
package. Folders and files are named as in the repository ``tum-vision/articulation``.
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
from kineverse.estimation.recordings import RecordedPair, read_recording
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
"""Label of each file, derived from the names of the objects."""

COLUMNS: Mapping[str, str] = MappingProxyType({"models_data/door.txt": "x,y,z,qx,qy,qz,qw,-,-"})
"""Columns of files that have more than those of a pose."""

POSITION, ORIENTATION = 0.01, math.radians(5.0)
"""Standard deviations of the deviation from an ideal joint, of each coordinate [m] and about each axis [rad].

They are larger than the sensor noise of a millimetre or less: hands slip, handles and hinges yield, and
planar markers have systematic orientation errors.
"""

THINNED = 20
"""Number of poses used of each recording, evenly over time, because errors of neighbours are correlated."""


@dataclass(frozen=True, eq=False)
class LabelledRecording:
    """Recording with its label."""

    name: str  # path of the file in its folder, without suffix
    label: Label  # true joint family
    poses: Array  # (N, 4, 4) of a marker, or positions (N, 3) of a handle, in the camera's frame [m]

    @property
    def covariance(self) -> Array:
        """Covariance of each pose (6, 6) or position (3, 3), the same for all recordings."""
        whole = pose_covariance(POSITION, ORIENTATION)
        return whole if self.poses.ndim == 3 else whole[:3, :3]


def read_labelled_recordings(folder: Path | None) -> Iterator[LabelledRecording]:
    """Return the recordings in a folder, sorted by name, reduced to some poses each.

    See :func:`read_labelled_pairs`.
    """
    return (
        LabelledRecording(name, label, pair.thin(THINNED).child_poses)
        for name, label, pair in read_labelled_pairs(folder)
    )


def read_labelled_pairs(folder: Path | None) -> Iterator[tuple[str, Label, RecordedPair]]:
    """Return names, labels and all poses of the recordings in a folder, sorted by name."""
    place = Path(FOLDER) if folder is None else folder
    found = sorted((file, label) for pattern, label in LABELS.items() for file in place.glob(pattern))
    if not found:
        what = "none of them is there" if place.is_dir() else "there is no such folder"
        raise FormatError(
            f"{place}: {what}. This experiment is about recordings of doors and drawers, cabinet_one/001.log "
            f"and so on, from {SOURCE}. Say where they are: --data FOLDER."
        )
    return (_read_labelled(file, file.relative_to(place), label) for file, label in found)


def _read_labelled(file: Path, name: Path, label: Label) -> tuple[str, Label, RecordedPair]:
    recording = read_recording(file, COLUMNS.get(name.as_posix()))
    return name.with_suffix("").as_posix(), label, recording.pair()
