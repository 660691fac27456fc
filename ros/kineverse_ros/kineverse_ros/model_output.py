"""Output of a model at a state: poses of its frames in their parents, and positions of all joints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse import compile as compile_expressions
from kineverse.errors import NoSolutionError
from kineverse.expressions import Expression, array, total_derivative
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .names import covers

Stamps: TypeAlias = npt.NDArray[np.int64]  # [ns]


class ModelOutput:
    """Poses and joints of a model as one compiled function of its coordinates.

    Frames that no coordinate moves in their parent are static. Joints are the free coordinates, those that
    closed loops determine, and articulations that follow others, such as mimic joints and gears.

    Parameters
    ----------
    model
        The model. Later edits of it have no effect.
    omitted
        Names of frames that are left to somebody else; one that ends in a slash stands for all below it.

    Attributes
    ----------
    coordinates
        Names of the free coordinates, in the order of the input vectors.
    joints
        Names of all joints.
    moving
        Names of frames that move in their parents.
    parents
        Parent of each frame.
    static
        Poses (4, 4) in the parents of the other frames.
    positions, velocities
        Of the joints, in their order; a velocity is NaN if it is not known.
    poses
        Poses of the moving frames in their parents (n, 7): positions [m], unit quaternions x y z w.
    problem
        Why some have none at the last values; empty if all have.

    Raises
    ------
    InvalidValueError
        If a parameter has no value.
    """

    def __init__(self, model: ModelView, omitted: Iterable[str] = ()) -> None:
        left_out = tuple(omitted)
        self.parents = {
            name: frame.parent
            for name, frame in model.frames.items()
            if name != WORLD and not any(covers(key, name) for key in left_out)
        }
        start = model.default_state()
        coordinates = model.degrees_of_freedom
        self.coordinates = tuple(map(str, coordinates))
        self.start = np.array([start[symbol] for symbol in coordinates])
        parameters = [symbol for symbol in model.symbols if not symbol.has_derivative]
        poses = {name: model.fk(name, parent) for name, parent in self.parents.items()}
        moved_by = {
            name: [self.coordinates.index(str(s)) for s in pose.symbols if s.has_derivative]
            for name, pose in poses.items()
        }
        self.moving = tuple(name for name, indices in moved_by.items() if indices)
        followers = _find_followers(model)
        self.joints = (*self.coordinates, *followers)
        rates = [total_derivative(follower) for follower in followers.values()]
        outputs = [
            array([poses[name] for name in self.moving]),
            array(list(followers.values())),
            array([rate if _is_known(rate, coordinates) else float("nan") for rate in rates]),
        ]
        inputs = [*coordinates, *(symbol.derivative() for symbol in coordinates), *parameters]
        self._evaluator = compile_expressions(outputs, inputs).bind()
        self._evaluator.input[2 * len(coordinates) :] = [start[symbol] for symbol in parameters]
        self.static = {
            name: pose({s: start[s] for s in pose.symbols})
            for name, pose in poses.items()
            if not moved_by[name]
        }
        places = {name: place for place, name in enumerate(self.coordinates)}
        followed = [[places[str(s)] for s in e.symbols if s.has_derivative] for e in followers.values()]
        own = [[place] for place in places.values()]
        self._movers = _Movers([*(moved_by[name] for name in self.moving), *own, *followed])
        self.problem = ""
        self.positions, self.velocities = np.zeros(len(self.joints)), np.zeros(len(self.joints))
        self.poses = np.zeros((len(self.moving), 7))

    def newest(self, stamps: Stamps) -> tuple[Stamps, Stamps]:
        """Return the newest stamp of what moves each of the moving frames, and each of the joints."""
        newest = self._movers.newest(stamps)
        return newest[: len(self.moving)], newest[len(self.moving) :]

    def evaluate(self, values: Array, speeds: Array) -> npt.NDArray[np.bool_]:
        """Compute all for values of the coordinates and their speeds, NaN where they are not known (n,).

        Returns
        -------
        numpy.ndarray of bool (n,)
            Which of the moving frames have a pose: none has one where a loop cannot be closed. The others
            keep the one before.
        """
        count = len(values)
        self._evaluator.input[:count], self._evaluator.input[count : 2 * count] = values, speeds
        self.problem = ""
        try:
            self._evaluator()
        except NoSolutionError as error:  # what belongs to the loop is NaN, the rest is there
            self.problem = str(error)
        poses, positions, velocities = self._evaluator.outputs
        self.positions[:count], self.positions[count:] = values, positions.ravel()
        self.velocities[:count], self.velocities[count:] = speeds, velocities.ravel()
        poses = poses.reshape(-1, 4, 4)  # of none, too
        is_placed = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        placed = slice(None) if is_placed.all() else is_placed
        rotations = _to_quaternions(poses[placed])
        is_opposite = np.einsum("ij,ij->i", rotations, self.poses[placed, 3:]) < 0.0
        rotations[is_opposite] *= -1.0
        self.poses[placed, :3], self.poses[placed, 3:] = poses[placed, :3, 3], rotations
        return is_placed


def _list_products() -> Array:
    """Return the matrix (16, 16) from the numbers of a pose to those of 4 q qᵀ (Shepperd 1978)."""
    result = np.zeros((4, 4, 4, 4))  # rows and columns of the pose, then those of the product
    for k in range(4):
        result[3, 3, k, k] = 1.0
        for i in range(3):
            result[i, i, k, k] = 1.0 if k in (i, 3) else -1.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for row, column, one, other, sign in (
            (i, j, i, j, 1),
            (j, i, i, j, 1),
            (j, i, 3, k, 1),
            (i, j, 3, k, -1),
        ):
            result[row, column, one, other] = result[row, column, other, one] = sign
    return result.reshape(16, 16)


_PRODUCTS = _list_products()


def _to_quaternions(poses: Array) -> Array:
    """Return the unit quaternions x y z w (n, 4) of poses (n, 4, 4), in few calls of numpy.

    Between two periods the caches are cold, and a call costs as much as its arithmetic for fifty frames.
    """
    products = (poses.reshape(-1, 16) @ _PRODUCTS).reshape(-1, 4, 4)
    largest = np.einsum("nii->ni", products).argmax(axis=1)
    rows = products[np.arange(len(products)), largest]
    rows /= np.sqrt(np.einsum("ij,ij->i", rows, rows))[:, None]
    return np.asarray(rows)


class _Movers:
    """Coordinates that move each of some things."""

    def __init__(self, indices: Sequence[Sequence[int]]) -> None:
        # A thing that nothing moves has the one after the last, which is never read.
        listed = [list(some) or [-1] for some in indices]
        self._indices = np.array([index for some in listed for index in some], dtype=np.intp)
        self._starts = np.cumsum([0, *map(len, listed)])[: len(listed)]

    def newest(self, stamps: Stamps) -> Stamps:
        """Return the newest of the stamps of the coordinates that move each; 0 where none does."""
        if not len(self._starts):
            return np.zeros(0, dtype=np.int64)
        extended = np.append(stamps, 0)
        newest: Stamps = np.maximum.reduceat(extended[self._indices], self._starts)
        return newest


def _find_followers(model: ModelView) -> dict[str, Expression]:
    """Return the positions of joints that are no free coordinates, by name."""
    names = set(map(str, model.degrees_of_freedom))
    found = {str(symbol): expression for symbol, expression in model.rates.dependent.items()}
    for name, record in model.articulations.items():
        if record.follows is not None and name not in names:
            found.setdefault(name, model.rates.resolve(record.follows))
    return found


def _is_known(rate: Expression, coordinates: tuple[Symbol, ...]) -> bool:
    """Return True for a rate that is a function of the coordinates and their own speeds."""
    return {symbol.position for symbol in rate.symbols if symbol.has_derivative} <= set(coordinates)
