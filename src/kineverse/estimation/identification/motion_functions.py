"""Motions whose functions are generated from one expression, for C and for the interpreter.

A motion is the pose parent_T_child(x, a) of a state x of its parameters and of joint values a. A step δ in
the parameters moves the state to x ∘ δ. Derivatives of the pose are twists of the child in the parent's axes,
about the child's origin.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self, TypeAlias

import casadi as ca
import numpy as np

from kineverse.compilation import CompiledFunction
from kineverse.compilation.function import compile_columns
from kineverse.errors import ShapeError
from kineverse.expressions.layout import SX
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .native import LinearisedPoses, evaluate_poses, problem_of


class ParameterPrior(NamedTuple):
    """Gaussian prior of the parameters: whitened residuals (m,) and their derivatives (m, n)."""

    residuals: Array
    by_parameters: Array


class MotionModel(Protocol):
    """Motion with values for its n parameters and k free joint values."""

    @property
    def size(self) -> int:
        """Number of parameters."""

    @property
    def joints(self) -> int:
        """Number of joint values."""

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives."""

    def retract(self, step: Array) -> Self:
        """Return the motion after a step (n,) in the parameters."""

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values (N, k) after a step (N, k), limited in size and to their domain."""

    def prior(self) -> ParameterPrior:
        """Return the prior of the parameters."""


class FamilyMember(MotionModel, Protocol):
    """Member of a joint family that is compared with other families."""

    @property
    def name(self) -> str:
        """Name of the family."""

    @property
    def rows(self) -> int:
        """6 for poses, 3 for positions."""

    @property
    def kinds(self) -> tuple[int, ...]:
        """Kind of each joint value. Joint values of one kind share the width of their range."""

    def log_prior(self, mean: Array) -> tuple[float, Array]:
        """Return the log prior of the parameters and of the mean joint values, for the evidence.

        The second result is a precision (n + k,) that is added to the one of :meth:`prior`. It keeps
        directions finite on which there are no data.
        """

    def named_parameters(self) -> dict[str, Array | float]:
        """Return the parameters by name, for display."""

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the n parameters."""


@dataclass(frozen=True)
class FixedMotion:
    """Motion with fixed parameters. Only its joint values are unknown."""

    motion: MotionModel

    size = 0

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return self.motion.joints

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives."""
        linear = self.motion.linearise(values)
        return linear._replace(by_parameters=linear.by_parameters[:, :, :0])

    def retract(self, step: Array) -> Self:
        """Return the motion itself: it has no parameters."""
        return self

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values (N, k) after a step."""
        return self.motion.retract_joints(values, step)

    def prior(self) -> ParameterPrior:
        """Return the empty prior."""
        return ParameterPrior(np.zeros(0), np.zeros((0, 0)))


Function: TypeAlias = "CompiledFunction[tuple[Array, ...]]"


@dataclass(frozen=True, eq=False)
class MotionFunctions:
    """Generated functions of a motion with K joint values and a step of M components.

    Each function has one input vector and one output vector: its arguments, and its results, in order.
    """

    linearise: Function  # x, a -> pose (3, 4), twists by δ (M, 6), twists by a (K, 6)
    states: int  # numbers of x, a, δ and of the prior's residuals
    joints: int
    steps: int = 0
    priors: int = 0
    retract: Function | None = None  # x, δ -> x ∘ δ
    slope: Function | None = None  # x, a, V (K, 6), q (3,) -> gradient of <V, J_a> + <q, p> by δ and a
    prior: Function | None = None  # x -> whitened residuals r of the prior, and their derivatives (r, M)

    def evaluate(self, points: Array) -> LinearisedPoses:
        """Return the poses at states and joint values (N, ...), and their derivatives by each."""
        (linear,) = self.linearise.batch(points)
        count, ends = len(points), 12 + 6 * self.steps
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3] = linear[:, :12].reshape(count, 3, 4)
        by_step = linear[:, 12:ends].reshape(count, self.steps, 6)
        by_joints = linear[:, ends:].reshape(count, self.joints, 6)
        return LinearisedPoses(poses, np.swapaxes(by_step, 1, 2), np.swapaxes(by_joints, 1, 2))

    def wait(self) -> None:
        """Wait until all of them are compiled, or cannot be."""
        for function in (self.linearise, self.retract, self.slope, self.prior):
            if function is not None:
                function.wait()


@dataclass(frozen=True)
class ParameterStep:
    """Step δ in the parameters of a motion, and what it does."""

    symbols: Sequence[Symbol]  # δ
    moved: SX  # x ∘ δ, exact to first order
    after: SX  # x ∘ δ
    derivatives: SX | None = None  # of the columns of the pose by δ at 0, (16, M); by default CasADi's


def generate(
    pose: SX,
    state: Sequence[Symbol],
    joints: Sequence[Symbol],
    step: ParameterStep | None = None,
    by_joints: SX | None = None,
    prior: SX | None = None,
) -> MotionFunctions:
    """Generate the functions of a motion from its pose (4, 4); a motion without step has no parameters.

    ``by_joints`` are the derivatives (16, K) of the columns of the pose, by default CasADi's. ``prior`` are
    the whitened residuals of the prior of the parameters.
    """
    x, a = _column(state), _column(joints)
    by_joints = ca.jacobian(ca.vec(pose), a) if by_joints is None else by_joints
    twists = _twists(pose, by_joints)
    top = ca.vec(pose[:3, :].T)
    if step is None:
        linearise = compile_columns([ca.vertcat(top, ca.vec(twists))], [*state, *joints])
        return MotionFunctions(linearise, len(state), len(joints))
    delta, none = _column(step.symbols), ca.DM.zeros(len(step.symbols))
    by_step = step.derivatives
    if by_step is None:
        moved_pose = ca.vec(ca.substitute(pose, x, step.moved))
        by_step = ca.substitute(ca.jacobian(moved_pose, delta), delta, none)
    linear = ca.vertcat(top, ca.vec(_twists(pose, by_step)), ca.vec(twists))
    gains = [Symbol(f"identification/gain {i}") for i in range(6 * len(joints))]
    lever = [Symbol(f"identification/lever {i}") for i in range(3)]
    weighted = ca.dot(_column(gains), ca.vec(twists)) + ca.dot(_column(lever), pose[:3, 3])
    gradient = ca.gradient(ca.substitute(weighted, x, step.moved), ca.vertcat(delta, a))
    residuals = ca.SX.zeros(0, 1) if prior is None else prior
    by_prior = ca.jacobian(ca.substitute(residuals, x, step.moved), delta).T
    of_prior = ca.substitute(ca.vertcat(residuals, ca.vec(by_prior)), delta, none)
    return MotionFunctions(
        compile_columns([linear], [*state, *joints]),
        len(state),
        len(joints),
        len(step.symbols),
        residuals.numel(),
        compile_columns([step.after], [*state, *step.symbols]),
        compile_columns([ca.substitute(gradient, delta, none)], [*state, *joints, *gains, *lever]),
        compile_columns([of_prior], state) if residuals.numel() else None,
    )


def _column(symbols: Sequence[Symbol]) -> SX:
    return ca.vertcat(*(s.sx for s in symbols)) if symbols else ca.SX.zeros(0, 1)


def _twists(pose: SX, derivatives: SX) -> SX:
    """Return twists of the child, (6, n), from derivatives (16, n) of the columns of its pose."""
    columns = []
    for i in range(derivatives.shape[1]):
        derivative = ca.reshape(derivatives[:, i], 4, 4)
        turned = derivative[:3, :3] @ pose[:3, :3].T
        columns.append(ca.vertcat(derivative[:3, 3], turned[2, 1], turned[0, 2], turned[1, 0]))
    return ca.horzcat(*columns) if columns else ca.SX.zeros(6, 0)


@dataclass(frozen=True, eq=False)
class MotionForm:
    """Common part of the motions of a family."""

    functions: MotionFunctions
    rows: int  # 6, or 3 for positions only
    parameters: tuple[int, ...]  # components of the step that are parameters
    joints: tuple[int, ...]  # joint values of the functions that are joint values of the family
    beliefs: tuple[int, ...]  # residuals of the prior that count
    kinds: tuple[int, ...]  # kind of each joint value: 0 for translations, 1 for rotations
    limits: Array  # largest step, lower and upper limit of each joint value, (3, k)
    # precision of the parameters and mean joint values that keeps unobservable directions finite, (n + k,)
    precision: Array
    # parameters that determine the mean pose together with the joint values; None if all parameters do
    movers: tuple[int, ...] | None = None


class GeneratedMotion(ABC):
    """Motion by generated functions: a form, and a state of its parameters."""

    @property
    @abstractmethod
    def form(self) -> MotionForm:
        """Form of the motion."""

    @property
    @abstractmethod
    def state(self) -> Array:
        """State x, contiguous."""

    @abstractmethod
    def log_density(self) -> float:
        """Return the log prior density of the parameters beyond a mean pose."""

    @abstractmethod
    def with_state(self, state: Array) -> Self:
        """Return the motion in another state."""

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.form.parameters)

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return len(self.form.joints)

    @property
    def kinds(self) -> tuple[int, ...]:
        """Kind of each joint value: 0 for translations, 1 for rotations."""
        return self.form.kinds

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives."""
        form = self.form
        if values.ndim != 2 or values.shape[1] != len(form.joints):
            raise ShapeError(f"Joint values have the shape (N, {len(form.joints)}), not {values.shape}.")
        problem = problem_of(form)
        if problem is not None:
            return evaluate_poses(problem, self.state, values)
        linear = form.functions.evaluate(self._points(values))
        by_parameters = linear.by_parameters[:, : form.rows, form.parameters]
        return LinearisedPoses(linear.pose, by_parameters, linear.by_joints[:, : form.rows, form.joints])

    def slope(self, values: Array, gains: Array, lever: Array) -> tuple[Array, Array]:
        """Return the gradients of <V, J_a> + <q, p> by the parameters (N, n) and joint values (N, k).

        V are gains (N, k, m), and q weights (N, 3) of the child's position p in the parent.
        """
        form, functions = self.form, self.form.functions
        weights = np.zeros((len(values), functions.joints, 6))
        weights[:, form.joints, : form.rows] = gains
        assert functions.slope is not None  # without parameters nobody asks
        points = np.concatenate([self._points(values), weights.reshape(len(values), -1), lever], axis=1)
        by = np.asarray(functions.slope.batch(points)[0])
        return by[:, form.parameters], by[:, functions.steps + np.array(form.joints, dtype=int)]

    def _points(self, values: Array) -> Array:
        """Return the state and all joint values of the functions for each observation."""
        form, state = self.form, self.state
        points = np.zeros((len(values), len(state) + form.functions.joints))
        points[:, : len(state)] = state
        points[:, len(state) + np.array(form.joints, dtype=int)] = values
        return points

    def retract(self, step: Array) -> Self:
        """Return the motion after a step (n,) in the parameters."""
        form, functions = self.form, self.form.functions
        if functions.retract is None or not form.parameters:
            return self
        whole = np.zeros(functions.steps)
        whole[list(form.parameters)] = step
        return self.with_state(functions.retract(np.concatenate([self.state, whole]))[0])

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values (N, k) after a step (N, k), limited in size and to their domain."""
        largest, lower, upper = self.form.limits
        return np.asarray(np.clip(values + np.clip(step, -largest, largest), lower, upper))

    def log_prior(self, mean: Array) -> tuple[float, Array]:
        """Return the log prior of the parameters beyond a mean pose, and its precision.

        The mean pose has the improper density 1 / (m³ rad³), which is the same for all families. So the
        density is times the volume of mean poses per unit of the parameters and joint values that move them.
        """
        form, log = self.form, self.log_density()
        if form.movers is not None:
            linear = self.linearise(mean[None, :])
            matrix = np.concatenate([linear.by_parameters[0][:, form.movers], linear.by_joints[0]], axis=1)
            # A lever of length zero has no volume. The bound has the size of an atom [m].
            lengths = np.abs(np.diagonal(np.linalg.qr(matrix)[1]))
            log += float(np.sum(np.log(np.maximum(lengths, 1e-10))))
        return log, form.precision

    def prior(self) -> ParameterPrior:
        """Return the Gaussian prior of the parameters."""
        form, functions = self.form, self.form.functions
        if functions.prior is None or not form.beliefs:
            return ParameterPrior(np.zeros(0), np.zeros((0, self.size)))
        numbers, beliefs = functions.prior(self.state)[0], list(form.beliefs)
        by = numbers[functions.priors :].reshape(functions.priors, functions.steps)
        return ParameterPrior(numbers[: functions.priors][beliefs], by[np.ix_(beliefs, form.parameters)])
