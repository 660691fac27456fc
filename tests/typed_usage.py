"""What a type checker has to say about a user's code: mypy checks it with the package, ``test_typing`` runs it."""

import contextlib
from collections.abc import Callable
from typing import Any, assert_type

import numpy as np
from numpy.typing import NDArray

import kineverse as kv

a, b = kv.position("a"), kv.position("b")
Numbers = NDArray[np.float64]

# Expressions stay expressions, with numbers on either side of methods and operators.
assert_type(2 * a + np.float64(1.0) * b, kv.Expression)
assert_type(kv.array([a, b]) @ np.eye(2), kv.Expression)
assert_type(kv.array([a, b]).sum(axis=0), kv.Expression)
assert_type(kv.array([a, b]).max(), kv.Expression)
assert_type(divmod(a, 2), tuple[kv.Expression, kv.Expression])
assert_type(round(a, 2), kv.Expression)
# numpy's own declarations say array; kv.array tells the checker better, and does nothing else.
assert_type(kv.array(np.sin(a)), kv.Expression)
assert_type(kv.array(np.stack([a, b])), kv.Expression)

# Compiled functions know what they return.
one, two = kv.compile(a * b), kv.compile([a * b, kv.rotation_z(a)])
assert_type(one({"a": 1.0, "b": 2.0}), Numbers)
assert_type(two([1.0, 2.0]), tuple[Numbers, ...])
assert_type(one.batch(np.zeros((3, 2))), Numbers)
assert_type(kv.compile(kv.array([1.0, 2.0]))(), Numbers)
kept: kv.CompiledFunction = one
either: kv.CompiledFunction[Any] = two
for convert in (kv.to_jax, kv.to_torch):
    with contextlib.suppress(kv.errors.MissingDependencyError):
        assert_type(convert(a * b, [a, b]), Callable[[Any], Any])

# Whatever has three numbers is an axis, whatever is 4×4 a place.
kv.Revolute(name="d", parent="world", child="d", axis=[0, 0, 1], origin=np.eye(4))
kv.Prismatic(
    name="d", parent="world", child="d", axis=np.array([0.0, 0.0, 1.0]), origin=kv.translation(1, 0, 0)
)
kv.Planar(name="d", parent="world", child="d", axis=(0, 0, 1), origin=np.eye(4).tolist())
kv.articulations.Universal(name="d", parent="world", child="d", first=[0, 0, 1], second=[0, 1, 0])
kv.quaternion([0, 0, 0, 1])
kv.quaternion(np.array([0, 0, 0, 1.0]))
kv.rpy((0.1, 0.2, 0.3))
kv.spatial.point([1, 2, 3])
kv.axis_angle([0, 0, 1], a)
kv.axis_angle(np.array([0, 0, 1.0]), 0.3)
kv.translation([1, 2, 3])
kv.transform(np.eye(3), [1, 2, 3])
with contextlib.suppress(kv.errors.InvalidValueError):
    kv.Revolute(name="d", parent="world", child="d", axis=3.0)  # type: ignore[arg-type]

# The face of the package: models, states, constraints, operations, loops.
model: kv.Model = kv.load("shelf_door")
assert_type(kv.formats.shipped_models(), tuple[str, ...])
assert "kitchen" in kv.shipped_models()
with model.edit() as edit:
    edit.add_frame("door", parent="world", transform=kv.rotation_x(a) @ kv.translation(np.ones(3)))
    edit.constrain("door/range", 0, a, kv.parameter("door/most", 2.0))
    edit.apply(kv.Continuous(name="wheel", parent="door", child="wheel", axis=np.array([0.0, 1.0, 0.0])))
    edit.apply(kv.Fixed(name="stop", parent="wheel", child="stop", origin=np.eye(4)))
    edit.apply(kv.Floating(name="cup", parent="stop", child="cup"))
    edit.apply(kv.articulations.Ball(name="ball", parent="cup", child="ball"))


def share() -> None:
    """Share a model; checked, and not run."""
    with contextlib.suppress(kv.ConflictError, kv.OfflineError), kv.exchange.serve(model) as server:
        assert_type(server, kv.exchange.Server)
        assert_type(kv.load("live:door", frames=["door"], bodies=True), kv.Model)
        assert_type(kv.exchange.list_servers(), list[str])


assert_type(model.fk("door"), kv.Expression)
assert_type(model.jacobian("wheel"), kv.Expression)
assert_type(model.constraints["door/range"], kv.Constraint)
assert_type(model.limits("a"), tuple[float, float])
home: kv.State = model.default_state()
values: kv.StateLike = {"a": 0.5}
values = {a: 0.5}
values = home
assert_type(home.updated({a: 0.25}), kv.State)
assert_type(model.violations(home).__class__.__name__, str)
assert_type(kv.velocity("a"), kv.Symbol)
assert_type(kv.acceleration("a"), kv.Symbol)
assert_type(a.derivative(), kv.Symbol)
assert kv.symbols.symbol("a") == a
assert_type(kv.rotation_y(a), kv.Expression)
assert_type(kv.inverse(model.fk("door")), kv.Expression)
assert_type(kv.where(a < b, a, 2.0), kv.Expression)
assert_type(kv.clip(a, 0.0, 1.0), kv.Expression)
assert_type(kv.maximum(a, b) + kv.minimum(a, 0.0) + kv.norm(kv.array([a, b])), kv.Expression)
assert_type(kv.spline(a, [0.0, 1.0, 2.0], [0.0, 1.0, 0.0]), kv.Expression)
assert_type(kv.logic.less(a, b), kv.Expression)
assert_type(kv.spatial.log_so3(kv.rotation_x(a)), kv.Expression)
assert_type(kv.expressions.total_derivative(a * b), kv.Expression)
assert_type(kv.Limits(0, 1).lower is None, bool)
loop = kv.CloseLoop(name="tie", frame="door", to="stop")
operations: list[kv.Operation] = [loop, kv.model.SetData("name", "value")]
try:
    model.fk("dor")
except kv.errors.UnknownNameError as error:
    base: kv.KineverseError = error
with kv.follow(model, lambda snapshot: kv.compile(snapshot.fk("door")), frames=["door"]) as follower:
    assert_type(follower.value, kv.compilation.CompiledFunction[Numbers])
scene: kv.geometry.Scene
tracker: kv.estimation.Tracker
goal = kv.control.Goal(a, 0.5, weight=2.0)
controller = kv.control.Controller(model, [goal, kv.control.Keep(0, 2 * a, 1)], dt=0.02)
assert_type(controller.step(home).residuals["goal a"], float)
found: kv.reasoning.Interlocks
motion = kv.planning.time_parameterize([[0.0, 0.0], [1.0, 2.0]], 1.0, [2.0, 3.0], [a, b])
assert_type(motion.at(0.5), kv.State)
assert_type(motion.positions_at([0.0, 0.5]), Numbers)
gripper: kv.grasping.Gripper
world: kv.worlds.SimulatedWorld = kv.worlds.MechanismWorld(model)
robot: kv.worlds.RobotInterface = world


def simulations(model: kv.Model) -> list[kv.worlds.SimulatedWorld]:
    """Return worlds that need extras; nobody calls it here."""
    return [kv.worlds.KinematicWorld(model, "robot"), kv.worlds.MujocoWorld(model, "robot")]


outcome: kv.manipulation.Outcome
shower = kv.show
version: str = kv.__version__
assert kv.loops.CloseLoop is kv.CloseLoop
