"""Where the links are, against pinocchio, for every URDF of the shared data that both can read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robots import LIMIT, SHARED, robot
from robots import joint as joint_text
from verdicts import verdict

import kineverse as kv
from kineverse.formats.urdf import Robot, parse_urdf, read_urdf
from kineverse.formats.urdf.operations import robot_operations

pin = pytest.importorskip("pinocchio")

# Pinocchio refuses negative efforts and materials defined twice; docs/urdf.md says why they are read here.
UNREADABLE = (
    "oems__eveR3_halodi__eve_r3_description__urdf__eve_r3.urdf",
    "random__robot-assets__halodi__eve_r3.urdf",
    "duplicate_materials.urdf",
)


def readable() -> list[Path | None]:
    """Return the files that are read here and by pinocchio, relative to the shared data."""
    files = sorted(path.relative_to(SHARED) for path in SHARED.rglob("*.urdf"))
    kept = [f for f in files if f.parts[0] != "urdf_conformance" or isinstance(verdict(f), int)]
    return [f for f in kept if f.name not in UNREADABLE] or [None]


def positions_of(robot: Robot, rng: np.random.Generator) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Return random values by coordinate, and for each moving joint pinocchio's numbers."""
    values: dict[str, float] = {}
    numbers: dict[str, list[float]] = {}
    for joint in robot.joints:
        if joint.kind == "floating":
            xyz, q = rng.uniform(-1, 1, 3), rng.normal(size=4)
            q /= np.linalg.norm(q)
            values |= dict(zip((f"{joint.name}/{c}" for c in "xyz"), xyz, strict=True))
            values |= dict(zip((f"{joint.name}/q{c}" for c in "xyzw"), q, strict=True))
            numbers[joint.name] = [*xyz, *q]
        elif joint.mimic is None and joint.kind in ("revolute", "continuous", "prismatic"):
            values[joint.name] = rng.uniform(-2, 2)
    for joint in robot.joints:
        if joint.kind in ("revolute", "continuous", "prismatic"):
            mimic = joint.mimic
            value = (
                values[joint.name] if mimic is None else mimic.multiplier * values[mimic.joint] + mimic.offset
            )
            numbers[joint.name] = [np.cos(value), np.sin(value)] if joint.kind == "continuous" else [value]
    return values, numbers


def compare(text: str, description: Robot, seed: int) -> None:
    reference = pin.buildModelFromXML(text)
    rng = np.random.default_rng(seed)
    values, numbers = positions_of(description, rng)
    configuration = np.concatenate([[]] + [numbers[name] for name in reference.names[1:]])
    data = reference.createData()
    pin.framesForwardKinematics(reference, data, configuration)
    model = kv.Model()
    with model.edit() as edit:
        for operation in robot_operations(description, "robot"):
            edit.apply(operation)
    # Two robots call their links "/base_link"; the empty part is left out.
    frames = ["robot/" + link.name.removeprefix("/") for link in description.links]
    root = "robot/" + description.root.removeprefix("/")
    poses = [model.fk(frame, root) for frame in frames]
    symbols = sorted({str(s) for pose in poses for s in pose.symbols})
    named = {symbol: values[symbol.removeprefix("robot/")] for symbol in symbols}
    for link, pose in zip(description.links, poses, strict=True):
        expected = data.oMf[reference.getFrameId(link.name, pin.FrameType.BODY)].homogeneous
        result = pose({s: named[str(s)] for s in pose.symbols})
        assert np.allclose(result, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max())), link.name


@pytest.mark.parametrize("file", readable(), ids=str)
def test_links_are_where_pinocchio_puts_them(file: Path | None):
    if file is None:
        pytest.skip(f"no {SHARED}")
    compare((SHARED / file).read_text(), read_urdf(SHARED / file), seed=len(file.name))


def test_every_type_in_one_chain():
    kinds = ["floating", "revolute", "prismatic", "continuous", "fixed", "revolute"]
    origin = '<origin xyz="0.{i} 0 .5" rpy="{i} -1.5707963267948966 .3"/><axis xyz="{i} 1 -.5"/>'
    text = robot(
        *(
            joint_text(f"j{i}", f"l{i}", f"l{i + 1}", kind, origin.format(i=i) + LIMIT)
            for i, kind in enumerate(kinds)
        ),
        links=len(kinds) + 1,
    )
    for seed in range(5):
        compare(text, parse_urdf(text), seed)
