"""Robots of the experiments: those that ship, and the authors' where their files are present."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from kineverse.errors import InvalidValueError
from kineverse.manipulation.robot_sources import SHIPPED, RobotSource, find_robot

_AUTHORS = {
    "pr2 (authors)": ("pr2", "pr2/pr2_description/robots/pr2.urdf", "r_gripper_palm_link"),
    "fetch (authors)": ("fetch", "fetch/fetch_description/robots/fetch.urdf", "gripper_link"),
    "hsr (authors)": ("hsr", "hsrb/hsrb_description/robots/hsrb.urdf", "hand_palm_link"),
}
DATA_FOLDERS = ("pr2", "fetch", "hsrb", "iai_kitchen")


def check_data(data: Path | None) -> Path | None:
    """Return the folder of the authors' files; None if none is given."""
    if data is None:
        return None
    if not data.is_dir():
        raise InvalidValueError(
            f"There is no folder {data} with robots. Leave --data out for the shipped ones."
        )
    if not any((data / name).is_dir() for name in DATA_FOLDERS):
        raise InvalidValueError(
            f"The folder {data} has none of {', '.join(DATA_FOLDERS)}, so nothing of the authors is in it."
        )
    return data


def find_robots(names: Iterable[str] = (), data: Path | None = None) -> tuple[RobotSource, ...]:
    """Return robots by name."""
    known = dict(SHIPPED)
    if data is not None:
        for name, (like, file, hand) in _AUTHORS.items():
            if (data / file).is_file():
                ours = SHIPPED[like]
                known[name] = RobotSource(
                    name, like, str(data / file), hand, ours.push_link, ours.start, ours.omni
                )
    return tuple(find_robot(name, known) for name in tuple(names) or known)
