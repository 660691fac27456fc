"""Operations of a model from a USD file: those of its document, else those that its joints stand for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from kineverse.errors import FormatError, summarize_error
from kineverse.formats.description import Matrix
from kineverse.formats.document.reader import entries_from_bytes
from kineverse.formats.export.joint_axes import as_vector3
from kineverse.formats.mimic import MimicRelation, resolve_mimic_chains
from kineverse.formats.names import TakenNames
from kineverse.formats.poses import is_identity
from kineverse.formats.reader_warnings import warn
from kineverse.formats.sdf.custom_attributes import SdfLoop
from kineverse.formats.sdf.description import (
    WORLD,
    SdfAxis,
    SdfFrame,
    SdfJoint,
    SdfJointType,
    SdfLink,
    SdfScene,
)
from kineverse.formats.sdf.joints import build_spanning_tree
from kineverse.formats.sdf.operations import sdf_operations
from kineverse.lie import inverse, round_exact
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Pose, is_empty_body
from kineverse.model.history import HistoryEntry
from kineverse.model.operation import Operation
from kineverse.model.registry import FileContent

from .bodies import UsdBodyReader
from .embedded_document import find_embedded_document
from .kinematics import positions_on_stage
from .pxr_api import ROTATIONS, TRANSLATIONS, open_stage, refuse_errors
from .scene import BALL, IN_WORLD, UsdFreedom, UsdJoint, UsdScene, read_scene

_STILL = 1e-6  # position [rad], [m] on a stage that is 0 in single precision


def usd_file_operations(file: FileContent) -> Iterator[tuple[str, Operation] | HistoryEntry]:
    """Yield the operations of a USD file: entries of its document if it has one that is current.

    A document of a stage that has changed since is passed over with a warning, and refused if ``strict``.
    """
    stage = open_stage(file.path)
    with refuse_errors(file.path.name):
        document = find_embedded_document(stage)
    if document is not None and document.is_current:
        source = f"{file.path}, its document"
        yield from entries_from_bytes(
            document.text.encode(), file.prefix, root=file.root or None, source=source
        )
        return
    if document is not None:
        changed = f"{file.path.name} has changed since Kineverse wrote it, and its document has not"
        if file.strict:
            raise FormatError(
                f"{changed}. Load it without strict to read its bodies and joints instead, or write it again."
            )
        warn([f"{changed}: its bodies and joints are read instead, as of any other stage."])
    scene = read_scene(stage, file.path.name)
    if file.strict and scene.remarks:
        raise FormatError(scene.remarks[0])
    yield from _scene_operations(scene, file)


def _scene_operations(scene: UsdScene, file: FileContent) -> Iterator[tuple[str, Operation]]:
    source = file.path.name
    if not scene.bodies:
        raise FormatError(
            f"{source} has nothing that moves: {_count_prims(scene)}, and no rigid body. Kineverse reads "
            "stages of UsdPhysics, with rigid bodies and joints between them."
        )
    with refuse_errors(source):
        reader = UsdBodyReader(scene, source)
        bodies = {path: reader.read(body) for path, body in scene.bodies.items()}
        world = reader.read(None)
    warn([*scene.remarks, *reader.finish()])
    if not is_empty_body(world):
        yield f"body {WORLD}", SetBody(WORLD, world)
    for operation in sdf_operations(_as_sdf(scene, bodies, source), file.prefix):
        yield operation.default_tag(), operation


def _count_prims(scene: UsdScene) -> str:
    count = sum(1 for _ in scene.stage.Traverse())
    return "it is empty" if not count else f"it has {count} prim{'s' if count > 1 else ''}"


def _as_sdf(scene: UsdScene, bodies: dict[str, Body], source: str) -> SdfScene:
    """Return a scene in the terms of SDF, whose reader makes the tree, the loops and the operations."""
    links = {
        path: SdfLink(
            body.name,
            bodies[path],
            _pose(body.pose),
            static=body.is_kinematic,
            free=body.free,
            home=body.home,
            source=source,
        )
        for path, body in scene.bodies.items()
    }
    between: list[SdfLink] = []
    joints: list[SdfJoint] = []
    names = {path: link.name for path, link in links.items()} | {IN_WORLD: WORLD}
    stage = positions_on_stage(scene)
    # Those that close loops come last, as the tree is made of the first ones that connect.
    for joint in sorted(scene.joints, key=lambda joint: joint.is_excluded):
        made, more = _joints(joint, names, stage, source)
        joints += made
        between += more
    joints = _resolve_mimics(joints, scene, source)
    remarks: list[str] = []

    def remark(joint: SdfJoint, text: str) -> None:
        remarks.append(f"{source}: the joint {joint.name} {text}")

    every = (*links.values(), *between)
    roots, tree, loops = build_spanning_tree(every, joints, (), remark)
    frames = tuple(SdfFrame(f.name, names[f.body], _pose(f.pose), source=source) for f in scene.frames)
    warn(remarks)
    taken = TakenNames([WORLD, *(link.name for link in every), *(frame.name for frame in frames)])
    tree = tuple(_turned(joint, taken) for joint in tree)
    loops = tuple(replace(joint, frame=taken.take(joint.name, f"{joint.name}/end")) for joint in loops)
    return SdfScene(every, frames, roots, tree, loops, source)


def _turned(joint: SdfJoint, taken: TakenNames) -> SdfJoint:
    """Return the same joint with its frame turned like that of its child, which may be that frame then."""
    offset, turn = joint.pose_in_child.matrix, np.eye(4)
    if joint.kind in ("fixed", "prismatic"):
        turn = inverse(offset)
    elif joint.kind != "ball":  # its coordinates are about the axes of its frame
        turn[:3, :3] = offset[:3, :3].T
    axes = tuple(
        replace(axis, xyz=as_vector3(round_exact(offset[:3, :3] @ np.array(axis.xyz)))) for axis in joint.axes
    )
    in_child = _pose(offset @ turn)
    return replace(
        joint,
        pose_in_parent=_pose(joint.pose_in_parent.matrix @ turn),
        pose_in_child=in_child,
        axes=axes,
        frame="" if is_identity(in_child) else taken.take(joint.name, f"{joint.name}/hinge"),
    )


def _joints(
    joint: UsdJoint, names: dict[str, str], stage: dict[str, float], source: str
) -> tuple[list[SdfJoint], list[SdfLink]]:
    """Return the joints that a joint stands for, and the links between them if there are several."""
    common = SdfJoint(
        joint.name,
        "fixed",
        names[joint.body0],
        names[joint.body1],
        _pose(joint.pose0),
        _pose(joint.pose1),
        loop=SdfLoop(joint.loop, joint.dependent) if joint.loop else None,
        source=source,
    )
    if not joint.freedoms:
        return [common], []
    made = [_single(common, joint, freedom, stage) for freedom in joint.freedoms]
    links = [SdfLink(f"{near.name}/link", source=source) for near in made[:-1]]
    for k, link in enumerate(links):
        made[k] = replace(made[k], child=link.name, pose_in_child=Pose())
        made[k + 1] = replace(made[k + 1], parent=link.name, pose_in_parent=Pose())
    return made, links


def _single(common: SdfJoint, joint: UsdJoint, freedom: UsdFreedom, stage: dict[str, float]) -> SdfJoint:
    """Return the joint of one degree of freedom; where the bodies of the stage are is its home."""
    rest = (0.0, 0.0, 0.0, 1.0) if freedom.kind == BALL else (0.0,)
    there = tuple(stage.get(name, x) for name, x in zip(freedom.coordinates, rest, strict=True))
    if np.abs(np.subtract(there, rest)).max() > _STILL:
        common = replace(common, home=there, zero=there)
    if freedom.kind == BALL:
        return replace(common, name=freedom.name, kind="ball")
    kinds = TRANSLATIONS if freedom.kind in TRANSLATIONS else ROTATIONS
    x, y, z = np.eye(3)[kinds.index(freedom.kind)].tolist()
    lower = freedom.lower if freedom.lower > -np.inf else None
    upper = freedom.upper if freedom.upper < np.inf else None
    velocity = joint.velocity if joint.velocity < np.inf else None
    axis = SdfAxis((x, y, z), lower, upper, velocity, freedom.dynamics, mimic=joint.mimic)
    kind: SdfJointType = "continuous" if lower is None and upper is None else "revolute"
    if kinds is TRANSLATIONS:
        kind = "prismatic"
    return replace(common, name=freedom.name, kind=kind, axes=(axis,))


def _resolve_mimics(joints: list[SdfJoint], scene: UsdScene, source: str) -> list[SdfJoint]:
    by_path = {joint.path: joint.name for joint in scene.joints}
    relations = {
        joint.name: MimicRelation(by_path[axis.mimic.leader], axis.mimic.multiplier, axis.mimic.offset)
        for joint in joints
        for axis in joint.axes
        if axis.mimic is not None
    }

    def refuse(name: str, reason: str) -> None:
        raise FormatError(f"{source}: the joint {name}: {reason}")

    ends = resolve_mimic_chains(relations, refuse)
    return [
        replace(joint, axes=(replace(joint.axes[0], mimic=ends[joint.name]),))
        if joint.name in ends
        else joint
        for joint in joints
    ]


def _pose(matrix: Matrix) -> Pose:
    try:
        return Pose.from_matrix(round_exact(matrix))
    except ValueError as error:
        raise FormatError(f"A pose on the stage is none: {summarize_error(error)}") from None
