"""The children of an element as texts, numbers, truth values and poses.

Every function raises :class:`ElementError` for what is missing or malformed; the reader adds file and line.
"""

from __future__ import annotations

import math

from kineverse.formats import numerals, rpy
from kineverse.formats.markup import TEXT, Element, ElementError, abbreviate, child, quote
from kineverse.formats.remarks import Remarks
from kineverse.model.body import Pose, Vector3

_TRUTH = {"true": True, "1": True, "false": False, "0": False}
_INFINITE = {"inf": math.inf, "+inf": math.inf, "-inf": -math.inf}
_UNBOUNDED = 1e16
"""Limits from this magnitude on bound nothing: older versions wrote so."""


def text_of(element: Element) -> str:
    """Return the text inside an element, without space around it."""
    return element[1].get(TEXT, "").strip()


def text(element: Element, tag: str) -> str:
    """Return the text of a child, which is empty where there is none."""
    part = child(element, tag)
    return "" if part is None else text_of(part)


def truth(element: Element, tag: str, default: bool = False) -> bool:
    """Return a truth value: true, false, 1 or 0."""
    part = child(element, tag)
    return default if part is None else _truth(part, text_of(part), default)


def attribute_truth(element: Element, key: str) -> bool:
    """Return a truth value that is an attribute, False where it is left out."""
    return _truth(element, element[1].get(key, ""), False)


def _truth(element: Element, said: str, default: bool) -> bool:
    if not said:
        return default
    if said.lower() not in _TRUTH:
        raise ElementError(element, f"says {quote(said)}, where true or false is expected.")
    return _TRUTH[said.lower()]


def number(element: Element, tag: str, default: float | None = None) -> float:
    """Return a finite number; without a default, the child is required."""
    return numbers(element, tag, 1, None if default is None else (default,))[0]


def numbers(
    element: Element, tag: str, count: int, default: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    """Return several finite numbers; without a default, the child is required."""
    part = child(element, tag)
    if part is None:
        if default is None:
            raise ElementError(element, f"has no <{tag}>; the specification requires it.")
        return default
    return listed(part, count)


def vector(element: Element, tag: str, default: Vector3 | None = None) -> Vector3:
    """Return three finite numbers; without a default, the child is required."""
    x, y, z = numbers(element, tag, 3, default)
    return x, y, z


def listed(element: Element, count: int) -> tuple[float, ...]:
    """Return the finite numbers that an element spells."""
    said = text_of(element)
    try:
        return (numerals.number(said),) if count == 1 else numerals.numbers(said, count)
    except ValueError as error:
        raise ElementError(element, f"says {quote(said)}: it {error}.") from None


def bound(element: Element, tag: str) -> float | None:
    """Return a limit, None where there is none: left out, infinite, or of magnitude 1e16 and more."""
    part = child(element, tag)
    if part is None or text_of(part).lower() in _INFINITE:
        return None
    (value,) = listed(part, 1)
    return None if abs(value) >= _UNBOUNDED else value


def direction(axis: Element) -> Vector3:
    """Return the unit vector of an ``<axis>``; the specification's default is z."""
    x, y, z = vector(axis, "xyz", (0.0, 0.0, 1.0))
    length = math.hypot(x, y, z)
    if length < 1e-9:
        raise ElementError(axis, f"has the direction {x:g} {y:g} {z:g}, which has length zero.")
    return (rpy.snap(x / length), rpy.snap(y / length), rpy.snap(z / length))


def pose_of(element: Element, remarks: Remarks) -> Pose:
    """Return what a ``<pose>`` says, in whichever of the formats of SDF 1.9."""
    layout = element[1].get("rotation_format", "euler_rpy")
    degrees = attribute_truth(element, "degrees")
    if layout not in ("euler_rpy", "quat_xyzw"):
        raise ElementError(
            element, f"has rotation_format={quote(layout)}; euler_rpy and quat_xyzw are the ones there are."
        )
    if not text_of(element):
        return Pose()
    if layout == "quat_xyzw":
        if degrees:
            raise ElementError(element, "is a quaternion in degrees; quaternions have no unit.")
        x, y, z, *xyzw = listed(element, 7)
        if not rpy.is_rotation(tuple(xyzw)):
            said = abbreviate(text_of(element))
            mistake = ElementError(element, f"says {said}: it has length zero, and so is no rotation.")
            remarks.mend(mistake, "nothing is turned")
        return rpy.pose_of_quaternion((x, y, z), tuple(xyzw))
    x, y, z, *angles = listed(element, 6)
    return rpy.pose_of((x, y, z), tuple(math.radians(a) if degrees else a for a in angles))
