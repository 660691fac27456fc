"""Rigid bodies: visual shapes, collision shapes, inertia, and constant poses.

Everything here is plain immutable data in the units [m], [kg] and [kg m²]. A mesh is a reference to a file,
and nothing here opens it. Documents contain these values as they are, so their layout is that of the fields.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt
from msgspec import Meta, Struct, field

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression

_RIGID = 2e-5
_FARTHEST = 1e100  # largest coordinate of a pose [m]. Products of a chain of such poses do not overflow

# A number of a document; other values, such as infinity, are refused when it is written or read.
Finite: TypeAlias = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Vector3: TypeAlias = tuple[Finite, Finite, Finite]
AxisLike: TypeAlias = "Sequence[float] | npt.NDArray[Any]"  # three numbers, not all zero
Rgba: TypeAlias = tuple[Finite, Finite, Finite, Finite]
_Rows: TypeAlias = Annotated[tuple[Finite, ...], Meta(min_length=12, max_length=12)]


class Pose(Struct, frozen=True, array_like=True, repr_omit_defaults=True, forbid_unknown_fields=True):
    """A constant rigid transform, stored as the 12 numbers of its first three rows.

    Examples
    --------
    >>> pose = kv.model.Pose.from_matrix(kv.translation(1, 2, 3))
    >>> pose.matrix[:3, 3]
    array([1., 2., 3.])
    """

    rows: _Rows = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.rows) != 12:
            raise ShapeError(f"A pose has 12 numbers, not {len(self.rows)}.")
        a, b, c, x, d, e, f, y, g, h, i, z = self.rows
        # Each comparison is False for NaN. Most poses of shapes do not turn.
        is_close = (
            -_FARTHEST <= x <= _FARTHEST and -_FARTHEST <= y <= _FARTHEST and -_FARTHEST <= z <= _FARTHEST
        )
        if a == e == i == 1.0 and b == c == d == f == g == h == 0.0 and is_close:
            return
        if not (
            is_close
            and abs(a * a + b * b + c * c - 1) < _RIGID
            and abs(d * d + e * e + f * f - 1) < _RIGID
            and abs(g * g + h * h + i * i - 1) < _RIGID
            and abs(a * d + b * e + c * f) < _RIGID
            and abs(a * g + b * h + c * i) < _RIGID
            and abs(d * g + e * h + f * i) < _RIGID
            and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0
        ):
            raise InvalidValueError(
                f"The pose is not rigid: the first three columns of {self.rows} must be a rotation "
                f"and all numbers finite, of at most {_FARTHEST:g}."
            )

    @staticmethod
    def from_matrix(matrix: npt.ArrayLike | Expression) -> Pose:
        """Build a pose from a 4×4 homogeneous matrix, of numbers or a constant expression.

        Raises
        ------
        ShapeError, InvalidValueError
            If it is not 4×4, or not rigid.

        Examples
        --------
        >>> kv.model.Pose.from_matrix(kv.rotation_z(0.5)).matrix[0, 0].round(3)
        np.float64(0.878)
        >>> kv.model.Pose.from_matrix(kv.rotation_z(kv.position("q")))
        Traceback (most recent call last):
            ...
        kineverse.errors.InvalidValueError: A pose is constant, and this transform moves with q.
        """
        if np.shape(matrix) != (4, 4):
            raise ShapeError(f"A pose is made from a 4×4 matrix, not from one of shape {np.shape(matrix)}.")
        if isinstance(matrix, Expression):
            if not matrix.is_constant:
                names = ", ".join(map(str, matrix.symbols))
                raise InvalidValueError(f"A pose is constant, and this transform moves with {names}.")
            matrix = matrix({})
        numbers = np.asarray(matrix, dtype=float)
        x, y, z, w = numbers[3].tolist()
        if not max(abs(x), abs(y), abs(z), abs(w - 1)) < _RIGID:
            raise InvalidValueError(f"The last row of a rigid transform is (0, 0, 0, 1), not {numbers[3]}.")
        return Pose(tuple(numbers[:3].ravel().tolist()))

    @property
    def matrix(self) -> npt.NDArray[Any]:
        """The 4×4 homogeneous matrix; a fresh array on every access."""
        matrix = np.eye(4)
        matrix[:3] = np.reshape(self.rows, (3, 4))
        return matrix


class _Geometry(
    Struct, frozen=True, tag_field="kind", tag=str.lower, omit_defaults=True, forbid_unknown_fields=True
):
    """Geometry with the name of its kind, which documents and other formats use."""

    kind: ClassVar[str]

    def __init_subclass__(cls) -> None:
        cls.kind = cls.__name__.lower()


class Box(_Geometry, frozen=True):
    """A box centred at its origin; ``size`` are the full edge lengths along x, y, z [m].

    See Also
    --------
    kineverse.model.Body
    """

    size: Vector3


class Cylinder(_Geometry, frozen=True):
    """A cylinder around z, centred at its origin; radius and length [m].

    See Also
    --------
    kineverse.model.Body
    """

    radius: Finite
    length: Finite


class Capsule(_Geometry, frozen=True):
    """A capsule around z, centred; ``length`` is that of the cylindrical part [m].

    See Also
    --------
    kineverse.model.Body
    """

    radius: Finite
    length: Finite


class Sphere(_Geometry, frozen=True):
    """A sphere around its origin; radius [m].

    See Also
    --------
    kineverse.model.Body
    """

    radius: Finite


class Ellipsoid(_Geometry, frozen=True):
    """An ellipsoid around its origin; ``radii`` are the half axes along x, y, z [m].

    See Also
    --------
    kineverse.model.Body
    """

    radii: Vector3


class Cone(_Geometry, frozen=True):
    """A cone around z, its base at -length/2 and its tip at +length/2; radius of the base and length [m].

    See Also
    --------
    kineverse.model.Body
    """

    radius: Finite
    length: Finite


class Mesh(_Geometry, frozen=True, eq=False):
    """Reference to a mesh file.

    ``uri`` is the reference in the description (``package://...``, ``file://...`` or a path). ``folder`` is
    the folder of the description, from which the reference is resolved when its triangles are needed.
    ``root`` is the folder that the resolved path must not leave, a real path: empty if no path is allowed,
    None if a program made the reference, which may open any file. ``content`` is the SHA-256 of the file and
    its size [byte], where they are known. Operations in documents contain only ``uri`` and ``scale``;
    comparisons ignore ``root`` and ``content``.

    Examples
    --------
    >>> kv.model.Mesh("package://kitchen/meshes/handle.dae", scale=(0.001, 0.001, 0.001)).uri
    'package://kitchen/meshes/handle.dae'
    """

    uri: str
    scale: Vector3 = field(default_factory=lambda: _UNSCALED)
    folder: str = ""
    root: str | None = None
    content: tuple[str, int] | None = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mesh) and self._key == other._key

    def __ne__(self, other: object) -> bool:  # that of a struct compares identities
        return not self == other

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[str, Vector3, str]:
        return self.uri, self.scale, self.folder


_UNSCALED: Vector3 = (1.0, 1.0, 1.0)
_IDENTITY = Pose()

Geometry: TypeAlias = Box | Cylinder | Capsule | Sphere | Ellipsoid | Cone | Mesh


class Shape(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Geometry at a pose in the frame of its body; visual shapes have a colour.

    Examples
    --------
    >>> tilted = kv.model.Pose.from_matrix(kv.rotation_x(0.3))
    >>> shape = kv.model.Shape(kv.model.Cylinder(radius=0.02, length=0.1), origin=tilted)
    >>> shape.geometry
    Cylinder(radius=0.02, length=0.1)
    """

    geometry: Geometry
    origin: Pose = field(default_factory=lambda: _IDENTITY)
    name: str = ""
    color: Rgba | None = None
    texture: str = ""


class Inertia(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Mass [kg] and rotational inertia [kg m²] about the centre of mass, in axes given by ``origin``.

    ``tensor`` is (ixx, ixy, ixz, iyy, iyz, izz); ``origin`` places the centre of mass in the body's frame.

    Examples
    --------
    >>> inertia = kv.model.Inertia(mass=2.0, tensor=(0.02, 0, 0, 0.02, 0, 0.01))
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.add_frame("crate", parent="world", body=kv.model.Body(inertia=inertia))
    'frame crate'
    >>> model.mass()
    2.0
    """

    mass: Finite
    tensor: tuple[Finite, Finite, Finite, Finite, Finite, Finite]
    origin: Pose = field(default_factory=lambda: _IDENTITY)


class Body(Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Rigid body that is attached to one frame.

    Examples
    --------
    >>> box = kv.model.Shape(kv.model.Box((0.4, 0.3, 0.2)))
    >>> body = kv.model.Body(visuals=(box,), collisions=(box,))
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.add_frame("crate", parent="world", transform=kv.translation(1, 0, 0.1), body=body)
    'frame crate'
    >>> model.bodies["crate"].collisions[0].geometry
    Box(size=(0.4, 0.3, 0.2))
    """

    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()
    inertia: Inertia | None = None


NO_BODY = Body()  # neither shapes nor inertia


def is_empty_body(body: Body) -> bool:
    """Return whether a body has neither shapes nor inertia."""
    return not body.visuals and not body.collisions and body.inertia is None
