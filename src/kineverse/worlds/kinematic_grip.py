"""Grip of a robot's fingers in a world without forces.

Closing fingers stop at a body of an object, unless it yields to the motion. The hold begins when bodies of
both fingers touch the same object from opposite sides, or one touches and the other is near. From then on
the fingers stay, and the object follows the hand: its coordinates minimise

    |c_object - c_hand|² + (0.1 m)² |log(R_object R_handᵀ)|²,

where c is the middle between the fingers and R the orientation, as they were relative to each other when the
hold began.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import array
from kineverse.grasping.fingertip_geometry import find_finger_range
from kineverse.grasping.gripper_detection import Gripper
from kineverse.lie import Array, inverse
from kineverse.model.model_view import ModelView
from kineverse.spatial import log_so3, skew
from kineverse.symbols import Symbol

from .quasistatic import SKIN, ObjectMotion, Residual
from .quasistatic_constraints import Gaps

TOUCH = 1e-4  # gap below which bodies touch [m]
ROTATION_ARM = 0.1  # length that makes rotations comparable to distances [m]
_OPPOSED = 0.5  # least cosine of the angle between the normal of a contact that holds and the closing motion
_ASLANT = 0.2  # least part of a finger's motion along the normal of a contact that stops it

_ROUNDS = 6


class _HoldError:
    """Error of the hold of a body, compiled as a function of its place in the hand."""

    def __init__(self, model: ModelView, hand: str, body: str, speeds: Sequence[Symbol]) -> None:
        places = [Symbol(f"world/hold/pose/{k}", 0, "parameter", 0.0) for k in range(12)]
        middles = [Symbol(f"world/hold/middle/{k}", 0, "parameter", 0.0) for k in range(3)]
        hand_T_body = array([*places, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
        body_p = array([*middles, 1.0])
        world_T_body, wanted = model.fk(body), model.fk(hand) @ hand_T_body
        twists, middle = model.jacobian(body, form="world", symbols=speeds), (world_T_body @ body_p)[:3]
        moved = middle - (wanted @ body_p)[:3]
        turned = ROTATION_ARM * log_so3(world_T_body[:3, :3] @ wanted[:3, :3].T)
        linear = twists[:3] - skew(middle) @ twists[3:]
        # A few calls a step: compiling C takes longer than all of them.
        self._function = compile(
            [np.concatenate([moved, turned]), np.concatenate([linear, ROTATION_ARM * twists[3:]])],
            (*model.symbols, *places, *middles),
            tier="interpreter",
        )
        self._count = len(model.symbols)

    def bind(self, hand_T_body: Array, middle: Array, q: Array) -> Residual:
        """Return the error (6,) in the world [m] and its derivatives (6, n), at what ``q`` is when asked."""
        evaluator, count = self._function.bind(), self._count
        evaluator.input[count:] = [*hand_T_body[:3].ravel(), *middle]

        def evaluate() -> tuple[Array, Array]:
            evaluator.input[:count] = q
            evaluator()
            error, derivatives = evaluator.outputs
            return error.copy(), derivatives.copy()

        return evaluate


class KinematicGrip:
    """Fingers that close, hold and open."""

    def __init__(
        self,
        motion: ObjectMotion,
        gripper: Gripper,
        near: float,
        slip: tuple[float, float],
        report: Callable[[str], None],
    ) -> None:
        model = motion.scene.model
        for s in gripper.joints:
            if s in model.rates or s.derivative() not in motion.columns or s not in motion.symbols:
                raise InvalidValueError(
                    f"'{s}' of the gripper at '{gripper.hand}' is no free coordinate of the model, so no "
                    "speed of its own moves it. Give a Gripper with the coordinates that open and close the "
                    "fingers."
                )
        self.gripper, self._motion, self._near, self._slip = gripper, motion, near, slip
        self._report = report
        self._at = np.array([motion.symbols.index(s) for s in gripper.joints], dtype=np.intp)
        self._closing = np.array([np.sign(gripper.closed[s] - gripper.opened[s]) for s in gripper.joints])
        self._range = np.array([find_finger_range(model, s) for s in gripper.joints]).reshape(-1, 2)
        self._hand_pose = compile(model.fk(gripper.hand), tier="interpreter")  # a few calls a step
        place = {s: k for k, s in enumerate(motion.symbols)}
        self._hand_inputs = np.array([place[s] for s in self._hand_pose.inputs], dtype=np.intp)
        number = {b: k for k, b in enumerate(motion.scene.bodies)}
        self._fingers = [
            np.array([number[b] for b in names if b in number], dtype=np.intp) for names in gripper.fingers
        ]
        self._errors: dict[str, _HoldError] = {}
        self.speeds: Array = np.zeros(len(self._at))
        self.held: str | None = None  # frame of the held body
        self._error: Residual  # of the hold
        self._may_hold = True

    def reset(self) -> None:
        """Let go, and stop the fingers."""
        self.speeds[:] = 0.0
        self._may_hold = True
        self._let_go()

    def command(self, speeds: Array) -> None:
        """Set the speeds of the fingers [m/s], [rad/s]; opening ones let go."""
        self.speeds[:] = speeds
        if (speeds * self._closing < 0.0).any():
            self._may_hold = True
            if self.held is not None:
                self._report(f"'{self.held}' is released")
                self._let_go()

    def steps(self, h: float) -> Array:
        """Return the motion of the fingers in a time h, within their limits (k,) [m], [rad]."""
        if self.held is not None:
            return np.zeros(len(self._at))
        q = self._motion.q[self._at]
        low, high = np.minimum(self._range[:, 0], q), np.maximum(self._range[:, 1], q)
        return np.clip(q + h * self.speeds, low, high) - q

    def move(self, h: float, moved: float) -> None:
        """Move fingers and objects in a time h [s], after the rest of the robot has moved."""
        motion = self._motion
        if self.held is not None:
            motion.resolve(h, moved, self._error)
            self._check()
            return
        step, start = self.steps(h), motion.q.copy()
        lever = np.sqrt(motion.weights[motion.count :])
        reach = moved + float(np.abs(step) @ lever)
        for _ in range(_ROUNDS):
            target = start.copy()
            target[self._at] += step
            motion.place(target)
            motion.resolve(h, reach)
            back = self._excess(motion.measure_gaps(0.0), step)
            if not back.any():
                break
            step = step - back
        if self._may_hold and (self.speeds * self._closing > 0.0).any():
            self._try_to_hold()

    def _excess(self, gaps: Gaps, step: Array) -> Array:
        """Return the part of the fingers' motion that objects do not yield to (k,)."""
        back = np.zeros(len(step))
        columns = gaps.rows[:, self._motion.count :]
        lever = np.sqrt(self._motion.weights[self._motion.count :])
        for depth, row in zip(-gaps.distances, columns, strict=True):
            # A finger goes back as far as the gap shrinks by its motion.
            into = np.where(row * np.sign(step) < -_ASLANT * lever, np.abs(row), 0.0)
            if depth > SKIN and into.any():
                k = int(np.argmax(into * np.abs(step)))
                back[k] = max(back[k], (depth + SKIN) / into[k])
        return np.minimum(back, np.abs(step)) * np.sign(step)

    def _try_to_hold(self) -> None:
        motion = self._motion
        pairs, index = motion.find_near(max(self._near, TOUCH))
        touched: list[dict[int, tuple[float, int]]] = [{}, {}]
        along = self._hand()[:3, :3] @ self.gripper.grasp_pose[:3, 1]
        for k in index.tolist():
            (a, b), normal = pairs.body_indices[k].tolist(), pairs.normals[k]
            for one, other, outwards in ((a, b, normal @ along), (b, a, -(normal @ along))):
                for finger, near, side in zip(self._fingers, touched, (1.0, -1.0), strict=True):
                    # Fingers that press against a front side by side do not hold it.
                    if one in finger and side * outwards >= _OPPOSED:
                        near.setdefault(int(motion.group[other]), (float(pairs.distances[k]), int(other)))
        common = touched[0].keys() & touched[1].keys()
        best = min(common, key=lambda g: min(touched[0][g], touched[1][g]), default=None)
        if best is None:
            return
        nearest = min(touched[0][best], touched[1][best])
        if nearest[0] > TOUCH:
            return
        self._take(motion.scene.bodies[nearest[1]])

    def hold(self, body: str) -> bool:
        """Hold a body where it is in the hand, if a finger is near it; return whether it is held."""
        motion = self._motion
        bodies = motion.scene.bodies
        group = motion.group[bodies.index(body)] if body in bodies else -1
        pairs, index = motion.find_near(max(self._near, TOUCH))
        fingers = np.concatenate(self._fingers)
        for pair in pairs.body_indices[index] if len(index) else ():
            if np.isin(pair, fingers).any() and (motion.group[pair] == group).any():
                self._take(body)
                return True
        self._report(f"'{body}' is not held any more")
        return False

    def place_of(self, body: str) -> Array:
        """Return the pose hand_T_body (4, 4) of a body."""
        place: Array = inverse(self._hand()) @ self._motion.scene.pose(body)
        return place

    def _take(self, body: str) -> None:
        motion = self._motion
        hand, world_T_body = self._hand(), motion.scene.pose(body)
        middle = inverse(world_T_body) @ hand @ self.gripper.grasp_pose[:, 3]
        if body not in self._errors:
            model, speeds = motion.scene.model, motion.columns[: motion.count]
            self._errors[body] = _HoldError(model, self.gripper.hand, body, speeds)
        self._error = self._errors[body].bind(inverse(hand) @ world_T_body, middle[:3], motion.q)
        self.held = body
        group = motion.group[motion.scene.bodies.index(body)]
        same = [b for k, b in enumerate(motion.scene.bodies) if motion.group[k] == group]
        motion.ignore(self.gripper.bodies, same)
        self._report(f"'{body}' is held")

    def _check(self) -> None:
        """Lose the held body if it is too far from its place in the hand."""
        error, _ = self._error()
        distance = float(np.linalg.norm(error[:3]))
        angle = float(np.linalg.norm(error[3:])) / ROTATION_ARM
        if distance > self._slip[0] or angle > self._slip[1]:
            off = f"{1e3 * distance:.3g} mm and {angle:.3g} rad"
            self._report(f"'{self.held}' is lost: it is {off} from its place in the hand")
            self._may_hold = False
            self._let_go()

    def _let_go(self) -> None:
        self.held = None
        self._motion.ignore()

    def _hand(self) -> Array:
        pose: Array = self._hand_pose(self._motion.q[self._hand_inputs])
        return pose
