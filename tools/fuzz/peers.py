"""Files that other parsers read and Kineverse refuses: ``PYTHONPATH=tools python -m fuzz.peers --minutes 5``.

A refusal is excused by one of six reasons, see ``EXCUSES``. A peer reads a file if it returns a model with
finite poses of at most 1e50; joints that it drops may have any numbers.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

import mujoco
import numpy as np
import pinocchio

import kineverse as kv
from kineverse.formats.loop_closures import LoopClosures
from kineverse.formats.xml_values import LARGEST

from .inputs import inputs
from .targets import TARGETS, Target
from .worker import make_input_folder

EXCUSES = {
    "entities": re.compile("document types and entities|undefined entity"),
    "size": re.compile("larger than|nested more than|characters long"),
    "root": re.compile("leads out of|names no file|the text has no folder|is no folder"),
    "xacro": re.compile("xacro"),
    "XML": re.compile("not well-formed XML|cannot be decoded"),
    "no link": re.compile("has no <link>"),
}
"""Patterns of error messages with which a file may be refused although other parsers read it."""

_MESH = re.compile(rb"<mesh\b[^<>]*/>")
"""Meshes of a URDF, whose files MuJoCo would open."""

_TOO_LARGE = re.compile("has a number beyond|has '[-+]?(inf|nan)")
"""Errors for numbers that are too large; other parsers may drop the joint that has them."""

_PARTICULARS = re.compile(r'line [0-9]+|"[^"]*"|[-+.0-9e]{3,}')


def find_peer(target: str, data: bytes) -> str:
    """Return the name of a peer that reads a file; empty if there is none."""
    if target == "urdf" and _read_by_pinocchio(data):
        return "pinocchio"
    if target in ("urdf", "mjcf") and _read_by_mujoco(data):
        return "MuJoCo"
    return ""


def unexcused_error(target: Target, data: bytes, folder: Path) -> str:
    """Return the message of an error that is not excused; empty if the file is read."""
    try:
        model = kv.Model()
        with model.edit() as edit:
            # As in kv.load, unsolvable loops stay constraints.
            closures = LoopClosures(edit, edit.model, "input", "equality", "solve")
            for tag, operation in target.operations(data, folder, None):
                list(closures.apply(tag, operation))
            list(closures.finish())
    except kv.KineverseError as error:
        text = str(error)
        excused = any(excuse.search(text) for excuse in (*EXCUSES.values(), _TOO_LARGE))
        return "" if excused else text
    return ""


def _read_by_pinocchio(data: bytes) -> bool:
    """Return True if pinocchio reads a file."""
    try:
        model = pinocchio.buildModelFromXML(data.decode())
        state = model.createData()
        pinocchio.forwardKinematics(model, state, pinocchio.neutral(model))
    except (ValueError, RuntimeError, IndexError):
        return False
    poses = [*model.jointPlacements, *state.oMi, *(frame.placement for frame in model.frames)]
    return all(_is_bounded(pose.homogeneous) for pose in poses)


def _read_by_mujoco(data: bytes) -> bool:
    """Return True if MuJoCo reads a file."""
    try:
        model = mujoco.MjModel.from_xml_string(_MESH.sub(b'<sphere radius="1"/>', data).decode())
        state = mujoco.MjData(model)
        mujoco.mj_kinematics(model, state)
    except (ValueError, RuntimeError, mujoco.FatalError):
        return False
    names = ("body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0", "site_pos", "site_quat")
    return all(map(_is_bounded, (state.xpos, state.xmat, *(getattr(model, name) for name in names))))


def _is_bounded(values: Any) -> bool:
    """Return True if all values are finite and not too large."""
    return bool((np.abs(values) <= LARGEST).all())


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the output of the peers."""
    sys.stdout.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def compare(target: Target, random: Random, folder: Path, end: float) -> tuple[int, int, dict[str, bytes]]:
    """Return the number of inputs, the number that a peer reads, and an input for each kind of refusal."""
    tried, read, found = 0, 0, {}
    for data in inputs(target, target.seeds(), random):
        if time.monotonic() > end:
            break
        tried += 1
        with quiet():
            by = find_peer(target.name, data)
        if not by:
            continue
        read += 1
        text = unexcused_error(target, data, folder)
        if text:
            kind = f"{by}: {_PARTICULARS.sub('…', text)[:110]}"
            found[kind] = min(found.get(kind, data), data, key=len)
    return tried, read, found


def main() -> int:
    """Compare the readers, print the results, and return the number of kinds of refusals."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.peers", description=__doc__)
    parser.add_argument("--target", choices=("urdf", "mjcf"), action="append", help="a format (both)")
    parser.add_argument("--minutes", type=float, default=5.0, help="how long, for all together (5)")
    parser.add_argument("--seed", type=int, default=1, help="of the search (1)")
    given = parser.parse_args()
    names = given.target or ["urdf", "mjcf"]
    mujoco.set_mju_user_warning(lambda _: None)
    total = 0
    for name in names:
        with tempfile.TemporaryDirectory() as top:
            end = time.monotonic() + 60 * given.minutes / len(names)
            tried, read, found = compare(TARGETS[name], Random(given.seed), make_input_folder(Path(top)), end)
        print(f"{name}: {tried} inputs, {read} read by others, {len(found)} kinds of refusals")
        for kind, data in found.items():
            print(f"  {kind}\n    {data[:600]!r}")
        total += len(found)
    return min(total, 99)


if __name__ == "__main__":
    sys.exit(main())
