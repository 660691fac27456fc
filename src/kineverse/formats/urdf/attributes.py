"""The attributes of an element as names, numbers and poses.

Every function raises :class:`ElementError` for what is missing or malformed; the reader adds file and line.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from kineverse.formats import numerals, rpy
from kineverse.formats.markup import Element, ElementError, abbreviate
from kineverse.formats.remarks import Remarks
from kineverse.model.body import Pose, Vector3

T = TypeVar("T")

_ZERO = (0.0, 0.0, 0.0)
_IDENTITY = Pose()


def number(element: Element, key: str, default: float | None = None) -> float:
    """Return a number; without a default, the attribute is required."""
    text = element[1].get(key)
    if text is None:
        return _default(element, key, default)
    try:
        return numerals.number(text)
    except ValueError as error:
        raise ElementError(element, f'{key}="{abbreviate(text)}" {error}.') from None


def vector(element: Element, key: str, default: Vector3 | None = None, turns: bool = False) -> Vector3:
    """Return three numbers, coordinates or what only turns; without a default, the attribute is required."""
    text = element[1].get(key)
    if text is None:
        return _default(element, key, default)
    try:
        if turns:
            return numerals.directions(text, 3)  # type: ignore[return-value]  # as many as asked for
        return numerals.numbers(text, 3)  # type: ignore[return-value]  # as many as asked for
    except ValueError as error:
        raise ElementError(element, f'{key}="{abbreviate(text)}" {error}.') from None


def mended(
    read: Callable[[], T], default: T, taken: str, remarks: Remarks, owner: Element | None = None
) -> T:
    """Return what is read, or a default with a remark: for what moves nothing if it is wrong.

    Raises
    ------
    ElementError
        Where the document is read strictly.
    """
    try:
        return read()
    except ElementError as mistake:
        remarks.mend(mistake, taken, owner)
        return default


def _default(element: Element, key: str, default: T | None) -> T:
    if default is None:
        raise ElementError(element, f"has no {key}; the specification requires it.")
    return default


def pose(origin: Element | None, owner: Element, version: tuple[int, int], remarks: Remarks) -> Pose:
    """Return the pose an ``<origin>`` gives; identity without one.

    URDF 1.1 brought ``quat_xyzw`` as another way to say ``rpy``; in a file of version 1.0 it is ignored.
    """
    if origin is None:
        return _IDENTITY
    xyz = _said(origin, "xyz", owner, remarks)
    quaternion = origin[1].get("quat_xyzw")
    if quaternion is not None and version < (1, 1):
        remarks.add(
            origin,
            'has quat_xyzw, which is ignored: it came with URDF 1.1. Write <robot version="1.1" ...>.',
            owner,
        )
        quaternion = None
    if quaternion is not None and "rpy" in origin[1]:
        mistake = ElementError(origin, "has both rpy and quat_xyzw; keep one of them.")
        remarks.mend(mistake, "rpy is what counts", owner)
        quaternion = None
    if quaternion is None:
        return rpy.pose_of(xyz, _said(origin, "rpy", owner, remarks))
    try:
        xyzw = numerals.unit(numerals.directions(quaternion, 4))
    except ValueError as error:
        mistake = ElementError(origin, f'quat_xyzw="{abbreviate(quaternion)}" {error}.')
        remarks.mend(mistake, "nothing is turned", owner)
        return rpy.pose_of(xyz, _ZERO)
    if not rpy.is_rotation(xyzw):
        mistake = ElementError(
            origin, f'quat_xyzw="{abbreviate(quaternion)}" has length zero, and so is no rotation.'
        )
        remarks.mend(mistake, "nothing is turned", owner)
    return rpy.pose_of_quaternion(xyz, xyzw)


def _said(origin: Element, key: str, owner: Element, remarks: Remarks) -> Vector3:
    """Return three numbers of an origin, zeros where they are left out, or empty."""
    if not origin[1].get(key, "0").strip():
        return mended(lambda: vector(origin, key), _ZERO, "zeros are taken", remarks, owner)
    return vector(origin, key, _ZERO, turns=key == "rpy")
