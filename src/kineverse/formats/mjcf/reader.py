"""MJCF files and text as checked descriptions.

``docs/mjcf.md`` lists the supported elements.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.names import NameFaultHandler, UniqueNames
from kineverse.formats.poses import IDENTITY, compose_poses, invert_pose
from kineverse.formats.reader_warnings import Fault, warn
from kineverse.formats.root_folder import find_text_root
from kineverse.model.body import Pose

from .bodies import MjcfBodies, MjcfShapes, mujoco_pose
from .compiled_document import CompiledMjcf, compile_document
from .custom_elements import merge_loop_closures
from .description import MjcfClosure, MjcfCoupling, MjcfDynamics, MjcfScene, MjcfTendon
from .elements import ElementRemark, MjcfElement
from .held_bodies import compute_rest_poses
from .mujoco_api import mujoco
from .preprocess import MjcfPreprocessor


def read_mjcf(
    path: str | os.PathLike[str], root: str | os.PathLike[str] | None = None, strict: bool = False
) -> MjcfScene:
    """Read an MJCF file, with what it includes and attaches; see :func:`parse_mjcf`.

    Raises
    ------
    FormatError
        If the file cannot be read or is not a valid MJCF; the message names file, line, element and reason.
    MissingDependencyError
        If MuJoCo is not installed.

    Examples
    --------
    >>> result = kv.load("shelf_door").save("shelf.xml")
    >>> scene = kv.formats.mjcf.read_mjcf("shelf.xml")
    >>> [joint.name for link in scene.links for joint in link.joints]
    ['shelf_door/door']
    """
    path = Path(path)
    return parse_mjcf(read_file(path), path.name, str(path.absolute().parent), root, strict)


def parse_mjcf(
    text: str | bytes,
    source: str = "<mjcf>",
    folder: str = "",
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
) -> MjcfScene:
    """Read an MJCF from text.

    Parameters
    ----------
    source
        Name of the document in error messages.
    folder
        Folder relative to which included files and meshes are found.
    root
        Folder that contains all of them; None for that of :func:`kineverse.formats.root_folder.find_root`.
    strict
        If True, mistakes that other parsers accept are errors. Otherwise they are warnings.

    Raises
    ------
    FormatError
        If the text is no valid MJCF; the message names source, line, element and reason.
    MissingDependencyError
        If MuJoCo is not installed.

    Examples
    --------
    >>> text = '''
    ... <mujoco>
    ...   <worldbody>
    ...     <body name="door">
    ...       <joint name="hinge" axis="0 0 1" range="0 90" limited="true"/>
    ...       <geom type="box" size="0.4 0.02 1" mass="10"/>
    ...     </body>
    ...   </worldbody>
    ... </mujoco>
    ... '''
    >>> scene = kv.formats.mjcf.parse_mjcf(text)
    >>> round(scene.links[1].joints[0].upper, 3)
    1.571
    """
    mjcf_warnings = _MjcfWarnings(source, strict)
    add, repair = mjcf_warnings.add, mjcf_warnings.repair
    root_folder = find_text_root(folder, root)
    preprocessor = MjcfPreprocessor(folder, root_folder, add, None if strict else mjcf_warnings.xml_fault)
    compiled = compile_document(preprocessor.run(text, source), source, folder, root_folder, add)
    shapes = MjcfShapes(compiled, folder, root_folder, add)
    bodies = MjcfBodies(compiled, shapes, source, add, repair)
    constraints = MjcfConstraints(compiled, bodies, add, repair)
    return MjcfScene(
        bodies.links,
        bodies.sites,
        constraints.couplings,
        constraints.closures,
        constraints.tendons,
        constraints.tendon_couplings,
        source,
        tuple(mjcf_warnings.texts),
        compiled.home is not None,
    )


class _MjcfWarnings:
    """Warnings about a document, each once."""

    def __init__(self, source: str, strict: bool) -> None:
        self._source, self._strict = source, strict
        self.texts: dict[str, None] = {}

    def add(self, node: MjcfElement | None, text: str) -> None:
        if node is not None:
            text = f"{node.place if node.source == self._source else node.where} {text}"
        if text not in self.texts:
            self.texts[text] = None
            warn([f"{self._source}, {text}"])

    def repair(self, where: str, problem: str, replacement: str) -> None:
        if self._strict:
            raise FormatError(f"{where}: {problem}.")
        self._fault(f"{where.removeprefix(f'{self._source}, ')}: {problem}; {replacement}.")

    def xml_fault(self, source: str, line: int, text: str) -> None:
        self._fault(f"{'' if source == self._source else f'{source}, '}line {line}, {text}")

    def _fault(self, text: str) -> None:
        self.texts[Fault(text)] = None
        warn([Fault(f"{self._source}, {text}")])


_CLOSURE_TOLERANCE = 1e-6  # largest distance between the ends of a loop [m], [rad]; files have six digits

_IDENTITY_WXYZ = (1.0, 0.0, 0.0, 0.0)


class MjcfConstraints:
    """Constraints of a compiled model: couplings, loop closures and tendons."""

    def __init__(
        self,
        compiled: CompiledMjcf,
        bodies: MjcfBodies,
        remark: ElementRemark,
        on_recoverable_error: NameFaultHandler,
    ) -> None:
        self._model, self._bodies, self._remark = compiled.model, bodies, remark
        model = compiled.model
        self._nodes = compiled.nodes(compiled.spec.equalities)
        self._tendon_nodes = compiled.nodes(compiled.spec.tendons)
        self._rest = compute_rest_poses(bodies.links)
        names = UniqueNames(on_recoverable_error)
        self._tendon_names = self._named(names, "tendon", model.ntendon, self._tendon_nodes)
        self._names = self._named(UniqueNames(on_recoverable_error), "equality", model.neq, self._nodes)
        found = [self._tendon(number) for number in range(model.ntendon)]
        self.tendons = tuple(tendon for tendon in found if tendon is not None)
        self._known = {tendon.name for tendon in self.tendons}
        couplings: list[MjcfCoupling] = []
        tendon_couplings: list[MjcfCoupling] = []
        closures: list[MjcfClosure] = []
        kinds = mujoco().mjtEq
        for number in range(model.neq):
            kind = model.eq_type[number]
            if not model.eq_active0[number]:
                remark(self._nodes.get(number), "is left out: it is not active.")
            elif kind == kinds.mjEQ_JOINT:
                rest = model.qpos0[model.jnt_qposadr]
                couplings.append(self._coupling(number, bodies.joint_names, rest))
            elif kind == kinds.mjEQ_TENDON:
                tendon_couplings += self._tendon_coupling(number)
            elif kind == kinds.mjEQ_CONNECT:
                closures += self._closure(number, "connect")
            elif kind == kinds.mjEQ_WELD:
                closures += self._closure(number, "weld")
            else:
                remark(self._nodes.get(number), "is left out: no constraint here expresses it.")
        self.couplings = tuple(couplings)
        loops = compiled.prepared.custom.loops
        self.closures = merge_loop_closures(tuple(closures), bodies.links, loops, remark)
        self.tendon_couplings = tuple(tendon_couplings)

    def _named(
        self, names: UniqueNames, kind: str, count: int, nodes: dict[int, MjcfElement | None]
    ) -> list[str]:
        """Return the names of equalities or tendons; those without name are numbered by tag."""
        result = [""] * count
        own = [getattr(self._model, kind if kind == "tendon" else "equality")(k).name for k in range(count)]
        for number in range(count):
            if own[number]:
                result[number] = names.take(own[number], self._where(nodes.get(number)))
        numbers: dict[str, int] = {}
        for number in range(count):
            if not own[number]:
                node = nodes.get(number)
                tag = kind if node is None else node.tag
                numbers[tag] = numbers.get(tag, -1) + 1
                result[number] = names.invent(f"{tag}{numbers[tag]}", self._where(node))
        return result

    def _where(self, node: MjcfElement | None) -> str:
        return "" if node is None else node.where

    def _tendon_coupling(self, number: int) -> Iterator[MjcfCoupling]:
        coupling = self._coupling(number, self._tendon_names, self._model.tendon_length0)
        if coupling.follower in self._known and (coupling.leader is None or coupling.leader in self._known):
            yield coupling
        else:
            self._remark(self._nodes.get(number), "is left out, as its tendon is.")

    def _coupling(self, number: int, names: Sequence[str], rest: npt.NDArray[np.float64]) -> MjcfCoupling:
        m = self._model
        follower, leader = int(m.eq_obj1id[number]), int(m.eq_obj2id[number])
        a, b, c, d, e = m.eq_data[number][:5].tolist()
        return MjcfCoupling(
            self._names[number],
            names[follower],
            names[leader] if leader >= 0 else None,
            (a, b, c, d, e),
            float(rest[follower]),
            float(rest[leader]) if leader >= 0 else 0.0,
            self._where(self._nodes.get(number)),
        )

    def _closure(self, number: int, kind: Literal["connect", "weld"]) -> Iterator[MjcfClosure]:
        """Yield a connect or weld equality, unless it is redundant or holds a mocap body."""
        m = self._model
        node, data = self._nodes.get(number), m.eq_data[number]
        ends = [int(m.eq_obj1id[number]), int(m.eq_obj2id[number])]
        if m.eq_objtype[number] == mujoco().mjtObj.mjOBJ_SITE:
            bodies = [int(m.site_bodyid[site]) for site in ends]
            names = [self._bodies.site_names[site] for site in ends]
            poses = [mujoco_pose(m.site_pos[site], m.site_quat[site]) for site in ends]
            inside = [IDENTITY, IDENTITY]  # the names are those of the sites
        else:
            bodies, names = ends, [self._bodies.body_names[body] for body in ends]
            if kind == "connect":
                poses = [mujoco_pose(data[:3], _IDENTITY_WXYZ), mujoco_pose(data[3:6], _IDENTITY_WXYZ)]
            else:
                poses = [mujoco_pose(data[3:6], data[6:10]), mujoco_pose(data[:3], _IDENTITY_WXYZ)]
            inside = poses
        if any(m.body_mocapid[body] >= 0 for body in bodies):
            self._remark(node, "is left out: it ties to a mocap body, by which a user drags another.")
            return
        where = self._where(node)
        if m.body_weldid[bodies[0]] == m.body_weldid[bodies[1]]:
            first, second = (
                compose_poses(self._rest[self._bodies.body_names[b]], pose)
                for b, pose in zip(bodies, poses, strict=True)
            )
            if _gap(first, second, kind) <= _CLOSURE_TOLERANCE:
                self._remark(node, "is left out: it ties bodies that are rigidly connected anyway.")
                return
        yield MjcfClosure(self._names[number], kind, names[0], names[1], inside[0], inside[1], where)

    def _tendon(self, number: int) -> MjcfTendon | None:
        m, kinds = self._model, mujoco().mjtWrap
        node = self._tendon_nodes.get(number)
        first = int(m.tendon_adr[number])
        steps = range(first, first + int(m.tendon_num[number]))
        terms: list[tuple[str, float]] = []
        paths: list[tuple[float, list[str]]] = [(1.0, [])]
        for step in steps:
            kind, wrapped, factor = m.wrap_type[step], int(m.wrap_objid[step]), float(m.wrap_prm[step])
            if kind == kinds.mjWRAP_JOINT:
                terms.append((self._bodies.joint_names[wrapped], factor))
            elif kind == kinds.mjWRAP_SITE:
                paths[-1][1].append(self._bodies.site_names[wrapped])
            elif kind == kinds.mjWRAP_PULLEY:
                paths.append((factor, []))
            else:
                self._remark(node, "is left out: it wraps round a geom.")
                return None
        lower = upper = None
        if m.tendon_limited[number]:
            lower, upper = m.tendon_range[number].tolist()
        return MjcfTendon(
            self._tendon_names[number],
            tuple(terms),
            tuple((divisor, tuple(sites)) for divisor, sites in paths if len(sites) > 1),
            lower,
            upper,
            self._tendon_dynamics(number),
            self._where(node),
        )

    def _tendon_dynamics(self, number: int) -> MjcfDynamics:
        m = self._model
        stiffness = float(m.tendon_stiffness[number])
        shortest, longest = m.tendon_lengthspring[number].tolist()
        values = {
            "damping": float(m.tendon_damping[number]),
            "friction": float(m.tendon_frictionloss[number]),
            "armature": float(m.tendon_armature[number]),
            "spring_stiffness": stiffness,
            "spring_lower": shortest if stiffness else 0.0,
            "spring_upper": longest if stiffness else 0.0,
        }
        return tuple((key, value) for key, value in values.items() if value)


def _gap(first: Pose, second: Pose, kind: str) -> float:
    """Return the distance between two ends [m]; for welds the larger of it and ‖R - I‖, R the rotation."""
    between = compose_poses(invert_pose(first), second).matrix
    gap = float(np.linalg.norm(between[:3, 3]))
    if kind == "weld":
        gap = max(gap, float(np.linalg.norm(between[:3, :3] - np.eye(3))))
    return gap
