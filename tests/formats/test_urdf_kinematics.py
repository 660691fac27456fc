"""Poses and Jacobians of all URDF files at hand, against pinocchio."""

from __future__ import annotations

import sysconfig
from pathlib import Path

import numpy as np
import pytest
from _pytest.mark import ParameterSet
from pinocchio_oracle import FORMS, PinocchioReference, pin
from scipy.spatial.transform import Rotation
from urdf_outcomes import expected_outcome
from urdf_texts import LIMIT, robot
from urdf_texts import joint as joint_text

import kineverse as kv
from kineverse.formats.urdf import UrdfRobot, parse_urdf, read_urdf
from kineverse.formats.urdf.operations import urdf_operations
from published_data import published_files, published_path, relative_name

DOCS = Path(__file__).parents[2] / "docs" / "urdf.md"
INSTALLED = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data/robots")
LEAVES = 5
CONFIGURATIONS = 2
TOLERANCE = 1e-12

# Read here but not by pinocchio, with what that says. docs/urdf.md says why they are read.
NOT_IN_PINOCCHIO = {
    "oems__eveR3_halodi__eve_r3_description__urdf__eve_r3.urdf": "min_effort are greater than max_effort",
    "random__robot-assets__halodi__eve_r3.urdf": "min_effort are greater than max_effort",
    "duplicate_materials.urdf": "does not contain a valid URDF model",
}
# What is no tree, or lacks what pinocchio asks for.
ONLY_HERE = (
    "collision_filter_group_parsing_test.urdf",
    "conflicting_materials.urdf",
    "joint_parsing_test.urdf",
    "joint_parsing_test_missing_screw_thread_pitch.urdf",
    "joint_parsing_test_missing_screw_thread_pitch_attribute.urdf",
    "joint_parsing_test_tag_mismatch_1.urdf",
    "non_conflicting_materials_2.urdf",
    "drake__atlas__urdf__robotiq_tendons.urdf",
    "drake__pr2__pr2_description__urdf__pr2_simplified.urdf",
    "collada_urdf_pr2_blank_lines_before_xml_decl.urdf",
    "oems__xacro_generated__open-manipulator_robotis__open_manipulator_description__urdf__open_manipulator.urdf",
)
# Files of example-robot-data that break the specification; urdf_outcomes.py lists the shared ones.
REFUSED = {
    "alex_description/urdf/alex_psyonic_hands.urdf": 'it mimics "index_q1", and there is no joint of that name',
    "ur_description/urdf/ur3.urdf": "line 6, <robot>: has no name",
}


def files() -> list[ParameterSet]:
    """Return the files to read, each with its name in the lists."""
    found = []
    for source, marks in (("the published data", pytest.mark.data), ("example-robot-data", ())):
        below = installed_files() if not marks else {relative_name(f): f for f in published_files(".urdf")}
        found += [
            pytest.param(file, id=name, marks=marks)
            for name, file in below.items()
            if is_readable(file, name)
        ]
        if not below:
            skip = pytest.mark.skip(reason=f"no URDF files of {source}")
            found.append(pytest.param(None, id=source, marks=[skip, *([marks] if marks else [])]))
    return found


def installed_files() -> dict[str, Path]:
    """Return the URDF files of example-robot-data by their path in it."""
    return {str(file.relative_to(INSTALLED)): file for file in sorted(INSTALLED.rglob("*.urdf"))}


def is_readable(file: Path, name: str) -> bool:
    if name.startswith("urdf_conformance"):
        return isinstance(expected_outcome(file), int) and file.name not in (*NOT_IN_PINOCCHIO, *ONLY_HERE)
    return name not in REFUSED


def assert_close(result: np.ndarray, expected: np.ndarray, what: str) -> None:
    size = max(1.0, np.abs(expected).max(initial=0))
    np.testing.assert_allclose(result, expected, rtol=0, atol=TOLERANCE * size, err_msg=what)


def assert_equal_to_pinocchio(reference: PinocchioReference, description: UrdfRobot, seed: int) -> None:
    """Compare the poses of all links, and the Jacobians of some leaf links, at random configurations."""
    model = kv.Model()
    with model.edit() as edit:
        for operation in urdf_operations(description, "robot"):
            edit.apply(operation)
    # Two robots call their links "/base_link"; the empty part is left out.
    frames = {link.name: "robot/" + link.name.removeprefix("/") for link in description.links}
    root = frames[description.root]
    parents = {joint.parent for joint in description.joints}
    leaves = [link for link in frames if link not in parents]
    leaves = leaves[:: max(1, len(leaves) // LEAVES)][:LEAVES]
    jacobians = [(link, form) for link in leaves for form in FORMS]
    poses = [model.fk(frame, root) for frame in frames.values()]
    columns = [model.jacobian(frames[link], root, form) for link, form in jacobians]
    f = kv.compile([*poses, *columns], [*model.degrees_of_freedom], tier="interpreter")
    rng = np.random.default_rng(seed)
    for _ in range(CONFIGURATIONS):
        values = reference.random_values(rng)
        reference.place(values)
        results = f({f"robot/{name}": value for name, value in values.items()})
        for link, result in zip(frames, results, strict=False):
            assert_close(result, reference.pose(link), link)
        for (link, form), result in zip(jacobians, results[len(frames) :], strict=True):
            # Ours has columns for what moves the link; all others have to be zero there.
            whole = np.zeros((6, len(reference.speeds)))
            own = [str(s).removeprefix("robot/") for s in model.speeds_of(frames[link], root)]
            whole[:, [reference.speeds.index(s) for s in own]] = result
            assert_close(whole, reference.jacobian(link, form), f"{form} Jacobian of {link}")


@pytest.mark.sampled(3)
@pytest.mark.parametrize("file", files())
def test_poses_and_jacobians_are_those_of_pinocchio(file: Path) -> None:
    assert_equal_to_pinocchio(PinocchioReference(file.read_text()), read_urdf(file), seed=len(file.name))


@pytest.mark.data
@pytest.mark.parametrize("name", NOT_IN_PINOCCHIO)
def test_files_that_pinocchio_cannot_read_are_listed(name: str) -> None:
    file = next(iter(published_files(name)), None) or published_path(name)
    with pytest.raises(ValueError, match=NOT_IN_PINOCCHIO[name]):
        PinocchioReference(file.read_text())
    assert read_urdf(file).dof == expected_outcome(file)


@pytest.mark.parametrize("name", REFUSED)
def test_robots_that_break_the_specification_are_read_with_a_remark(name: str) -> None:
    file = INSTALLED / name
    if not file.exists():
        pytest.skip(f"no {name} of example-robot-data")
    with pytest.raises(kv.errors.FormatError) as info:
        read_urdf(file, strict=True)
    assert REFUSED[name] in str(info.value)
    if name.endswith("ur3.urdf"):
        with pytest.raises(kv.errors.FormatError, match=r"has no <link>.*is expanded"):
            read_urdf(file)
    else:
        assert REFUSED[name] in "".join(read_urdf(file).remarks)


@pytest.mark.parametrize("name", [*NOT_IN_PINOCCHIO, *REFUSED])
def test_docs_list_files_that_cannot_be_compared(name: str) -> None:
    rows = [row for row in DOCS.read_text().splitlines() if f"`{name.rsplit('__', 1)[-1]}`" in row]
    message = {**NOT_IN_PINOCCHIO, **REFUSED}[name]
    assert any(message in row for row in rows), rows


ORIGIN = '<origin xyz="0.{i} 0 .5" rpy="{i} -1.5707963267948966 .3"/>'


@pytest.mark.parametrize("seed", range(3))
def test_chain_of_all_joint_types_moves_as_in_pinocchio(seed: int) -> None:
    kinds = [
        "floating",
        "revolute",
        "planar",
        "prismatic",
        "continuous",
        "fixed",
        "planar",
        "floating",
        "revolute",
    ]
    kinds = [str(kind) for kind in np.random.default_rng(seed).permutation(kinds)]
    # Pinocchio leaves the axis of a planar joint out of account, so that one is z.
    axes = ["0 0 1" if kind == "planar" else f"{i} 1 -.5" for i, kind in enumerate(kinds)]
    text = robot(
        *(
            joint_text(
                f"j{i}", f"l{i}", f"l{i + 1}", kind, f'{ORIGIN.format(i=i)}<axis xyz="{axis}"/>{LIMIT}'
            )
            for i, (kind, axis) in enumerate(zip(kinds, axes, strict=True))
        ),
        links=len(kinds) + 1,
    )
    assert_equal_to_pinocchio(PinocchioReference(text), parse_urdf(text), seed)


@pytest.mark.parametrize("normal", [(1, 0, 0), (0, -3, 0), (1, 2, -3), (0.3, -0.1, 2), (0, 0, -1)], ids=str)
def test_planar_joint_of_any_normal_is_a_rotated_one_about_z(normal: tuple[float, ...]) -> None:
    """The plane of the docs: A turns z into the normal, and the child is turned back by its transpose."""
    angle = np.arctan2(np.hypot(*normal[:2]), normal[2])
    about = np.array([-normal[1], normal[0], 0.0]) if any(normal[:2]) else np.array([1.0, 0, 0])
    turn = Rotation.from_rotvec(angle * about / np.linalg.norm(about))

    def fixed(name: str, parent: str, child: str, rotation: Rotation) -> str:
        rpy = " ".join(map(repr, pin.rpy.matrixToRpy(rotation.as_matrix()).tolist()))
        return joint_text(name, parent, child, "fixed", f'<origin rpy="{rpy}"/>')

    arm = joint_text("arm", "l1", "l2", "revolute", f'<origin xyz="1 2 3"/><axis xyz="0 1 0"/>{LIMIT}')
    axis = '<axis xyz="{} {} {}"/>'.format(*normal)
    ours = robot(joint_text("puck", "l0", "l1", "planar", axis), arm, links=3)
    theirs = robot(
        fixed("there", "l0", "l3", turn),
        joint_text("puck", "l3", "l4", "planar", '<axis xyz="0 0 1"/>'),
        fixed("back", "l4", "l1", turn.inv()),
        arm,
        links=5,
    )
    assert_equal_to_pinocchio(PinocchioReference(theirs), parse_urdf(ours), seed=1)


def test_mimic_chains_between_joint_types_move_as_in_pinocchio() -> None:
    """A slide follows an axle that follows an axle; both columns add up in one speed."""

    def follow(source: str, factor: float, offset: float) -> str:
        return f'<axis xyz="0 1 1"/><mimic joint="{source}" multiplier="{factor}" offset="{offset}"/>{LIMIT}'

    text = robot(
        joint_text("slide", "l0", "l1", "prismatic", follow("axle", -0.3, 0.2)),
        joint_text("axle", "l1", "l2", "continuous", follow("arm", 2, -1)),
        joint_text("arm", "l2", "l3", "revolute", LIMIT),
        joint_text("hand", "l3", "l4", "revolute", f'<origin xyz="1 0 0"/>{LIMIT}'),
        links=5,
    )
    reference = PinocchioReference(text)
    assert_equal_to_pinocchio(reference, parse_urdf(text), seed=2)
    assert reference.speeds == ["arm:velocity", "hand:velocity"]
    np.testing.assert_allclose(reference.speed_map[:, 0], [-0.6, 2, 1, 0])
