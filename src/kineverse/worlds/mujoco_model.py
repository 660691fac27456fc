"""Models as MuJoCo specifications: joints with friction, contacts, servos, and excluded pairs of bodies."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.export.capabilities import UnsupportedError
from kineverse.formats.mjcf.mujoco_api import capture_mujoco_warnings, mujoco
from kineverse.formats.mjcf.writer import to_mjcf
from kineverse.geometry.collision_filter import adjacent_pairs, allowed_pairs, apply_rules, read_rules
from kineverse.geometry.distance_queries import flag_between, flag_relatively_moving
from kineverse.lie import Array
from kineverse.model.model_view import ModelView

from .mujoco_state import MujocoCoordinates
from .robot import Robot

CURVE_TOLERANCE = 0.01  # largest error of a joint on a curve, which MuJoCo has as a polynomial [m], [rad]
_DRAWER = 3.0, 5.0
_DOOR = 1.0, 1.0
_KNOB = 0.02, 0.02
_BUTTON = 0.2, 2.0  # friction [N], [N m] and damping [N s/m], [N m s] of furniture that states neither
_KNOB_MASS = 1.0
_DENSITY, _MESH_MASS = 500.0, 0.5  # assumed for bodies without inertia [kg/m³], and for a mesh [kg]
_CONDIM = 6
_STIFF_SOLIMP = (0.99, 0.999, 0.001)  # MuJoCo's default impedance gives way by some 10 %
_RESTING = 1e-4  # depth up to which shapes of furniture rest on each other, and collide [m]
_SWEEP = 65  # number of places between its limits at which a joint is checked
_FOLDER = Path("/")


def export_spec(
    model: ModelView, leave_out: Collection[str], locks: Collection[str], remark: Callable[[str], None]
) -> Any:
    """Return a model as an ``MjSpec``, without its visual shapes.

    A motion along a curve is approximated within :data:`CURVE_TOLERANCE`. Constraints among ``locks`` are
    left out without a remark, as the world has them.
    """
    engine, path, names = mujoco(), _FOLDER / "world.xml", (*leave_out, *locks)
    silent = tuple(f"'{name}' is left out" for name in locks)
    try:
        written = to_mjcf(model, path, names, visuals=False)
    except UnsupportedError:
        written = to_mjcf(model, path, names, CURVE_TOLERANCE, visuals=False)
    for text in written.remarks:
        if not text.startswith(silent):
            remark(text)
    for frame, error in written.errors.items():
        remark(f"'{frame}' moves by a polynomial in place of a curve, off by {error} at most")
    with capture_mujoco_warnings():
        spec = engine.MjSpec.from_string(written.content.decode())
    companions = {
        path.relative_to(_FOLDER).as_posix(): data for path, data in written.companion_files.items()
    }
    spec.assets = companions
    for mesh in spec.meshes:
        if mesh.file not in companions:
            mesh.file = str(_FOLDER / mesh.file)
    return spec


def compile_world(spec: Any) -> Any:
    """Return the ``MjModel`` of a specification."""
    engine = mujoco()
    with capture_mujoco_warnings():
        try:
            return spec.compile()
        except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
            raise FormatError(f"MuJoCo does not take the world: {error}") from None


def rigid_parts(body: Any) -> list[Any]:
    """Return a body of a specification and all below it that do not move in it."""
    parts = [body]
    for part in parts:
        parts += [child for child in part.bodies if not child.joints]
    return parts


def add_masses(spec: Any, remark: Callable[[str], None]) -> None:
    """Give moving bodies without inertia that of their collision shapes."""
    engine, assumed = mujoco(), []
    for body in spec.bodies:
        parts = rigid_parts(body) if body.joints else []
        if not parts or any(part.explicitinertial and part.mass > 0 for part in parts):
            continue
        geoms = [geom for part in parts for geom in part.geoms]
        for geom in geoms:
            if geom.type == engine.mjtGeom.mjGEOM_MESH:
                geom.mass = _MESH_MASS
            else:
                geom.mass, geom.density = math.nan, _DENSITY
        for part in parts:
            part.explicitinertial = False
        if geoms:
            assumed.append(body.name)
    if assumed:
        remark(
            f"{', '.join(assumed)} {'has' if len(assumed) == 1 else 'have'} no inertia: that of the "
            f"collision shapes is taken, of {_DENSITY:g} kg/m³, and {_MESH_MASS:g} kg for a mesh"
        )


def remark_missing_shapes(spec: Any, robot: Callable[[str], bool], remark: Callable[[str], None]) -> None:
    """Remark on moving furniture without collision shapes, which nothing can touch."""
    moving = [body for body in spec.bodies if body.joints and not robot(body.name)]
    names = [body.name for body in moving if not any(part.geoms for part in rigid_parts(body))]
    if names:
        remark(f"nothing can touch {', '.join(names)}: without collision shapes")


def add_joint_friction(
    spec: Any,
    compiled: Any,
    coordinates: Iterable[str],
    friction: Mapping[str, float],
    remark: Callable[[str], None],
) -> None:
    """Give friction and damping to the joints of furniture."""
    engine = mujoco()
    assumed: dict[str, list[str]] = {}
    for name in coordinates:
        joint = spec.joint(name)
        if joint is None or joint.type not in (engine.mjtJoint.mjJNT_SLIDE, engine.mjtJoint.mjJNT_HINGE):
            continue
        if not np.any(joint.damping) and not joint.frictionloss:
            body = compiled.jnt_bodyid[compiled.joint(name).id]
            slides = joint.type == engine.mjtJoint.mjJNT_SLIDE
            light = compiled.body_subtreemass[body] < _KNOB_MASS
            if slides:
                given = _BUTTON if light and np.any(joint.stiffness) else _DRAWER
            else:
                given = _KNOB if light else _DOOR
            joint.frictionloss = given[0]
            joint.damping = _like(joint.damping, given[1])
            units = ("N", "N s/m") if slides else ("N m", "N m s")
            what = f"friction {given[0]:g} {units[0]} and damping {given[1]:g} {units[1]}"
            assumed.setdefault(what, []).append(name)
        # With MuJoCo's default a door creeps although friction holds it.
        stiff = _solref(spec), _STIFF_SOLIMP
        joint.solref_friction[:2], joint.solimp_friction[:3] = stiff
        if name in friction:
            joint.frictionloss = friction[name]
            remark(f"'{name}' has the friction {friction[name]:g}, as asked for")
    for what, names in assumed.items():
        remark(f"{what} are assumed, as the model states none: {', '.join(names)}")


def add_tipping_springs(spec: Any, model: ModelView, remark: Callable[[str], None]) -> None:
    """Give a mechanism the spring that tips at an angle: τ = stiffness (q - tipping), weight included.

    The parts that it moves have no weight of their own then.
    """
    for name, record in model.articulations.items():
        known = dict(record.dynamics)
        stiffness, tipping = known.get("spring/stiffness"), known.get("spring/tipping")
        joint = spec.joint(record.coordinates[0].path) if len(record.coordinates) == 1 else None
        if joint is None or not isinstance(stiffness, (int, float)) or not isinstance(tipping, (int, float)):
            continue
        joint.stiffness, joint.springref = _like(joint.stiffness, -float(stiffness)), float(tipping)
        for frame in model.frames:
            if record.coordinates[0] in model.symbols_of(frame):
                spec.body(frame).gravcomp = 1.0
        remark(f"'{name}' has its spring, which includes the weight of what it moves: gravity does not act")


def add_contact_rules(
    spec: Any,
    model: ModelView,
    fingers: Iterable[Sequence[str]],
    friction: float,
    robot: Robot,
    remark: Callable[[str], None],
) -> None:
    """Set the stiffness of constraints and exclude the pairs of bodies that do not collide.

    Those of furniture that moves relatively collide, also a door and its frame, unless a rule excepts them;
    others, if a scene checks them.
    """
    engine, held = mujoco(), {name for finger in fingers for name in finger}
    for body in spec.bodies:
        for number, geom in enumerate(body.geoms):
            geom.friction[0] = friction
            geom.name = geom.name or f"{body.name}/shape/{number}"
            if body.name in held:
                geom.condim, geom.priority = _CONDIM, 1
                geom.solref[:2], geom.solimp[:3] = _solref(spec), _STIFF_SOLIMP
    option = spec.option
    option.cone, option.impratio = engine.mjtCone.mjCONE_ELLIPTIC, 10.0
    option.integrator = engine.mjtIntegrator.mjINT_IMPLICITFAST
    # Pairs that may touch are listed one by one; MuJoCo would leave out a door with a frame that moves.
    option.disableflags |= engine.mjtDisableBit.mjDSBL_FILTERPARENT
    bodies = [body.name for body in spec.bodies if body.geoms and body.name in model.frames]
    furniture = np.array([not robot.owns(name) for name in bodies], dtype=bool)
    rules, objects = read_rules(model), [v for v in model.speeds if not robot.moves(v)]
    moved = flag_relatively_moving(model, bodies, objects)
    checked = np.where(
        flag_between(furniture, furniture),
        apply_rules(np.ones_like(moved, dtype=np.uint8), bodies, rules) * moved,
        allowed_pairs(model, bodies, rules),
    )
    for i, k in zip(*np.nonzero(np.triu(1 - checked, 1)), strict=True):
        spec.add_exclude(bodyname1=bodies[i], bodyname2=bodies[k])
    solref = _solref(spec)
    for joint in spec.joints:
        joint.solref_limit[:2], joint.solimp_limit[:3] = solref, _STIFF_SOLIMP
    for tie in spec.equalities:
        tie.solref[:2], tie.solimp[:3] = solref, _STIFF_SOLIMP
    remark(f"contacts have friction {friction:g}, elliptic cones and impratio {option.impratio:g}")


def weigh_contacts(compiled: Any, bodies: Iterable[int]) -> None:
    """Give contacts of some bodies the inertia that their shapes have, not that of their centres of mass.

    MuJoCo regularises a contact by the motion that a force at the centre of mass causes. Of a door whose
    description puts that on the hinge, as many do that state none, this is zero, and the solver fails.
    Contacts of light parts with a spring are stiff: a finger would sink into a button by millimetres.
    """
    engine, data = mujoco(), mujoco().MjData(compiled)
    engine.mj_forward(compiled, data)
    jacobian, solved = np.zeros((3, compiled.nv)), np.zeros((3, compiled.nv))
    for body in bodies:
        for geom in _geoms_of(compiled, body):
            engine.mj_jac(compiled, data, jacobian, None, data.geom_xpos[geom], body)
            engine.mj_solveM(compiled, data, solved, jacobian)
            weight = float((jacobian * solved).sum()) / 3.0
            compiled.body_invweight0[body, 0] = max(compiled.body_invweight0[body, 0], weight)
            joints = compiled.body_jntadr[body] + np.arange(compiled.body_jntnum[body])
            if compiled.body_subtreemass[body] < _KNOB_MASS and np.any(compiled.jnt_stiffness[joints]):
                compiled.geom_priority[geom] = 1
                compiled.geom_solref[geom] = 2.0 * float(compiled.opt.timestep), 1.0
                compiled.geom_solimp[geom, :3] = _STIFF_SOLIMP


def exclude_overlaps(
    spec: Any,
    compiled: Any,
    model: ModelView,
    coordinates: MujocoCoordinates,
    is_robot: Callable[[str], bool],
    samples: int,
    seed: int,
) -> list[tuple[str, str]]:
    """Exclude shapes that overlap by design, and return the pairs of their bodies.

    These are pairs of bodies of the robot that overlap at the default state or in all sampled ones, and pairs
    of shapes of furniture that overlap at the default state. Of two bodies of furniture, some of whose shapes
    overlap, the others collide. Excluded are also bodies that one joint keeps apart between its limits.
    """
    data, random = mujoco().MjData(compiled), np.random.default_rng(seed)
    of_robot = np.array([is_robot(compiled.body(k).name) for k in range(compiled.nbody)])

    def find_overlaps() -> dict[tuple[int, int], float]:
        return {(min(a, b), max(a, b)): gap for a, b, gap in _find_contacts(compiled, data) if gap < 0.0}

    def pairs_of_robot(found: Iterable[tuple[int, int]]) -> set[tuple[int, int]]:
        pairs = (sorted(compiled.geom_bodyid[list(pair)].tolist()) for pair in found)
        return {(a, b) for a, b in pairs if of_robot[a] and of_robot[b]}

    data.qpos[:] = coordinates.positions(coordinates.default)
    at_home, move = find_overlaps(), coordinates.mover()
    always: set[tuple[int, int]] | None = None
    for _ in range(samples):
        move(data, random.uniform)
        here = pairs_of_robot(find_overlaps())
        always = here if always is None else always & here
        if not always:
            break
    bodies = pairs_of_robot(at_home) | (always or set())
    shapes: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for (a, b), gap in at_home.items():
        one, other = compiled.geom_bodyid[[a, b]].tolist()
        if gap < -_RESTING and not of_robot[one] and not of_robot[other]:
            pair = (a, b) if one < other else (b, a)
            shapes.setdefault((min(one, other), max(one, other)), set()).add(pair)
    for (one, other), overlapping in shapes.items():
        bodies.add((one, other))
        for a, b in product(*(_geoms_of(compiled, body) for body in (one, other))):
            if (a, b) not in overlapping:
                geoms = compiled.geom(a), compiled.geom(b)
                pair = spec.add_pair(geomname1=geoms[0].name, geomname2=geoms[1].name)
                pair.condim, pair.friction[:2] = 3, geoms[0].friction[0]
    names = [(compiled.body(a).name, compiled.body(b).name) for a, b in sorted(bodies)]
    met = {*shapes}
    for share in np.linspace(0.0, 1.0, _SWEEP).tolist():
        move(data, partial(_between, share=share))
        deep = (pair for pair, gap in find_overlaps().items() if gap < -_RESTING)
        met |= {tuple(sorted(compiled.geom_bodyid[list(pair)].tolist())) for pair in deep}
    apart = [pair for pair in _limited_joints(model, compiled) if tuple(sorted(pair)) not in met]
    for a, b in (*names, *((compiled.body(a).name, compiled.body(b).name) for a, b in apart)):
        spec.add_exclude(bodyname1=a, bodyname2=b)
    return names


def _between(lower: Array, upper: Array, share: float) -> Array:
    return lower + share * (upper - lower)


def _find_contacts(compiled: Any, data: Any) -> Iterator[tuple[int, int, float]]:
    """Yield the pairs of shapes that MuJoCo's collision detection finds, with their distances [m]."""
    engine = mujoco()
    engine.mj_kinematics(compiled, data)
    engine.mj_comPos(compiled, data)
    engine.mj_collision(compiled, data)
    for (a, b), gap in zip(data.contact.geom.tolist(), data.contact.dist.tolist(), strict=True):
        yield a, b, gap


def _limited_joints(model: ModelView, compiled: Any) -> list[tuple[int, int]]:
    names = [compiled.body(k).name for k in range(compiled.nbody)]
    known = {name: k for k, name in enumerate(names) if name in model.frames and compiled.body_geomnum[k]}
    result = []
    bodies = list(known)
    for i, k in np.argwhere(np.triu(adjacent_pairs(model, bodies), 1)).tolist():
        symbols = model.fk(bodies[i], bodies[k]).symbols
        limited = all(np.isfinite(model.limits(s)).all() for s in symbols)
        if len(symbols) == 1 and limited:
            result.append((known[bodies[i]], known[bodies[k]]))
    return result


def _geoms_of(compiled: Any, body: int) -> range:
    first = int(compiled.body_geomadr[body])
    return range(first, first + int(compiled.body_geomnum[body]))


def _like(present: Any, value: float) -> Any:
    """Return a coefficient in the form of the present one: in newer MuJoCo, the first of a polynomial."""
    return np.array([value, *[0.0] * (np.size(present) - 1)]) if np.ndim(present) else value


def _solref(spec: Any) -> tuple[float, float]:
    """Return the time constant [s] and the damping ratio of stiff constraints: two steps are the least."""
    return 2.0 * float(spec.option.timestep), 1.0


_STANDS = -0.01, 0.005  # gaps between the floor and bodies that stand or roll on it [m]


def add_floor(
    spec: Any,
    coordinates: MujocoCoordinates,
    is_robot: Callable[[str], bool],
    names: Collection[str],
    samples: int,
    seed: int,
    remark: Callable[[str], None],
) -> None:
    """Add a floor to a specification, unless a body reaches below it.

    Bodies that stand on it at the default state, such as wheels, have no contact with it, unless they are
    loose and would fall. There is no floor if another body is below it then, or if furniture is in any
    sampled state: then z = 0 is no floor.
    """
    engine, name = mujoco(), "floor"
    while name in names:
        name += "_"
    body = spec.worldbody.add_body(name=name)
    geom = body.add_geom(type=engine.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], margin=_STANDS[1])
    compiled = compile_world(spec)
    data, random = engine.MjData(compiled), np.random.default_rng(seed)
    floor = compiled.body(name).id

    def touching() -> dict[str, float]:
        result: dict[str, float] = {}
        for one, other, gap in _find_contacts(compiled, data):
            a, b = compiled.geom_bodyid[[one, other]].tolist()
            if floor in (a, b):
                touched = compiled.body(a + b - floor).name
                result[touched] = min(gap, result.get(touched, gap))
        return result

    data.qpos[:] = coordinates.positions(coordinates.default)
    standing, move = touching(), coordinates.mover()
    below = {b for b, gap in standing.items() if gap < _STANDS[0]}
    for _ in range(samples):
        move(data, random.uniform)
        below |= {b for b, gap in touching().items() if gap < _STANDS[0] and not is_robot(b)}
    geom.margin = 0.0
    if below:
        geom.contype = geom.conaffinity = 0
        reason = f"{', '.join(sorted(below))} {'reaches' if len(below) == 1 else 'reach'} below z = 0"
        remark(f"there is no floor, as {reason}")
        return
    roots = {b: compiled.body_jntadr[compiled.body_rootid[compiled.body(b).id]] for b in standing}
    free = engine.mjtJoint.mjJNT_FREE
    borne = sorted(b for b, k in roots.items() if is_robot(b) or k < 0 or compiled.jnt_type[k] != free)
    for other in borne:
        spec.add_exclude(bodyname1=name, bodyname2=other)
    text = f"; these stand on it, without contact: {', '.join(borne)}" if borne else ""
    remark(f"there is a floor at z = 0{text}")
