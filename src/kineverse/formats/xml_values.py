"""Values of XML attributes and elements: names, numbers, vectors, truth values, poses.

Several numbers together are coordinates, at most ``LARGEST``: products of larger ones overflow, and a pose
would not be finite. A single number may be a limit, and 1.8e308 stands for no limit.

Descriptions repeat the same values ("0 0 0" by the hundred), so results are cached.

The ``parse_`` functions raise ``ValueError`` with the reason; the ``read_`` functions raise
:class:`ElementError` for a missing or malformed value, to which the reader adds file and line.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

from kineverse.lie import snap
from kineverse.model.body import Pose, Vector3

from . import poses
from .reader_warnings import ReaderWarnings
from .xml_reader import TEXT, Element, ElementError, abbreviate, find_child, quote

LARGEST = 1e50  # largest magnitude of coordinates, positions, and factors between positions
SMALLEST = 1e-50  # smallest factor between positions except 0; below, limits of a follower are out of reach

_MAX_LENGTH = 1000


@lru_cache(maxsize=8192)
def parse_number(text: str) -> float:
    """Parse one finite number."""
    return _parse_words(text, 1)[0]


@lru_cache(maxsize=8192)
def parse_directions(text: str, count: int) -> tuple[float, ...]:
    """Parse ``count`` numbers of any magnitude: angles, or the components of an axis or a quaternion."""
    return _parse_words(text, count)


def scale_to_bounds(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return a vector, scaled down if its length would overflow."""
    largest = max(map(abs, values))
    return values if largest <= LARGEST else tuple(value / largest for value in values)


@lru_cache(maxsize=8192)
def parse_numbers(text: str, count: int) -> tuple[float, ...]:
    """Parse ``count`` coordinates, separated by white space."""
    values = _parse_words(text, count)
    if values and max(map(abs, values)) > LARGEST:
        raise ValueError(f"has a number beyond {LARGEST:g}, where {_expected(count)}")
    return values


def _parse_words(text: str, count: int) -> tuple[float, ...]:
    if len(text) > _MAX_LENGTH:
        raise ValueError(f"is {len(text)} characters long, where {_expected(count)}")
    words = text.split()
    if len(words) != count:
        found = {0: "is empty", 1: "is one word"}.get(len(words), f"has {len(words)} words")
        raise ValueError(f"{found}, where {_expected(count)}{_hint(text)}")
    return tuple([_parse_word(word, count) for word in words])


def _parse_word(word: str, count: int) -> float:
    # Python accepts more than a description may contain: underscores between digits, and other scripts.
    if "_" in word or not word.isascii():
        raise ValueError(f"has '{abbreviate(word)}', where {_expected(count)}")
    try:
        value = float.fromhex(word) if "0x" in word[:3].lower() else float(word)
    except OverflowError:
        value = math.inf
    except ValueError:
        raise ValueError(f"has '{abbreviate(word)}', where {_expected(count)}{_hint(word)}") from None
    if not math.isfinite(value):
        raise ValueError(f"has '{word}', where {_expected(count)}; leave a limit out if there is none")
    return value


def _expected(count: int) -> str:
    return "a finite number is expected" if count == 1 else f"{count} finite numbers are expected"


def _hint(text: str) -> str:
    if "${" in text or "$(" in text:
        return "; this is xacro, expand it first: a file called robot.urdf.xacro is expanded"
    if "," in text:
        return "; numbers are separated by spaces and have a decimal point"
    return ""


T = TypeVar("T")

_ZERO = (0.0, 0.0, 0.0)


def read_attribute_number(element: Element, key: str, default: float | None = None) -> float:
    """Read a number; without a default, the attribute is required."""
    text = element[1].get(key)
    if text is None:
        return _require_default(element, key, default)
    try:
        return parse_number(text)
    except ValueError as error:
        raise ElementError(element, f'{key}="{abbreviate(text)}" {error}.') from None


def read_attribute_vector(
    element: Element, key: str, default: Vector3 | None = None, turns: bool = False
) -> Vector3:
    """Read three coordinates, or with ``turns`` an axis or angles; without a default, they are required."""
    text = element[1].get(key)
    if text is None:
        return _require_default(element, key, default)
    try:
        x, y, z = parse_directions(text, 3) if turns else parse_numbers(text, 3)
        return x, y, z
    except ValueError as error:
        raise ElementError(element, f'{key}="{abbreviate(text)}" {error}.') from None


def read_or_default(
    read: Callable[[], T], default: T, taken: str, remarks: ReaderWarnings, owner: Element | None = None
) -> T:
    """Read a value that affects no motion; with a mistake, warn and return a default."""
    try:
        return read()
    except ElementError as mistake:
        remarks.repair(mistake, taken, owner)
        return default


def _require_default(element: Element, key: str, default: T | None) -> T:
    if default is None:
        raise ElementError(element, f"has no {key}; the specification requires it.")
    return default


def read_origin(
    origin: Element | None, owner: Element, version: tuple[int, int], remarks: ReaderWarnings
) -> Pose:
    """Read the pose of an ``<origin>``; identity without one.

    URDF 1.1 introduced ``quat_xyzw`` as an alternative to ``rpy``; in a file of version 1.0 it is ignored.
    """
    if origin is None:
        return poses.IDENTITY
    xyz = _read_origin_vector(origin, "xyz", owner, remarks)
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
        remarks.repair(mistake, "rpy is what counts", owner)
        quaternion = None
    if quaternion is None:
        return poses.pose_from_rpy(xyz, _read_origin_vector(origin, "rpy", owner, remarks))
    try:
        xyzw = scale_to_bounds(parse_directions(quaternion, 4))
    except ValueError as error:
        mistake = ElementError(origin, f'quat_xyzw="{abbreviate(quaternion)}" {error}.')
        remarks.repair(mistake, "nothing is turned", owner)
        return poses.pose_from_rpy(xyz, _ZERO)
    if not poses.is_valid_quaternion(xyzw):
        mistake = ElementError(
            origin, f'quat_xyzw="{abbreviate(quaternion)}" has length zero, and so is no rotation.'
        )
        remarks.repair(mistake, "nothing is turned", owner)
    return poses.pose_from_quaternion(xyz, xyzw)


def _read_origin_vector(origin: Element, key: str, owner: Element, remarks: ReaderWarnings) -> Vector3:
    """Read three numbers of an origin, zeros if they are left out or empty."""
    if not origin[1].get(key, "0").strip():
        return read_or_default(
            lambda: read_attribute_vector(origin, key), _ZERO, "zeros are taken", remarks, owner
        )
    return read_attribute_vector(origin, key, _ZERO, turns=key == "rpy")


_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}
_INFINITE = {"inf": math.inf, "+inf": math.inf, "-inf": -math.inf}
_UNBOUNDED = 1e16  # magnitude from which a limit counts as none, as in older versions of SDF


def read_text(element: Element) -> str:
    """Read the text inside an element, without space around it."""
    return element[1].get(TEXT, "").strip()


def read_child_text(element: Element, tag: str) -> str:
    """Read the text of a child; empty if there is none."""
    part = find_child(element, tag)
    return "" if part is None else read_text(part)


def read_child_bool(element: Element, tag: str, default: bool = False) -> bool:
    """Read a child with a truth value: true, false, 1 or 0."""
    part = find_child(element, tag)
    return default if part is None else _parse_bool(part, read_text(part), default)


def read_attribute_bool(element: Element, key: str) -> bool:
    """Read an attribute with a truth value, False if it is left out."""
    return _parse_bool(element, element[1].get(key, ""), False)


def _parse_bool(element: Element, said: str, default: bool) -> bool:
    if not said:
        return default
    if said.lower() not in _BOOLEANS:
        raise ElementError(element, f"says {quote(said)}, where true or false is expected.")
    return _BOOLEANS[said.lower()]


def read_child_number(element: Element, tag: str, default: float | None = None) -> float:
    """Read a child with a finite number; without a default, it is required."""
    return read_child_numbers(element, tag, 1, None if default is None else (default,))[0]


def read_child_numbers(
    element: Element, tag: str, count: int, default: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    """Read a child with several finite numbers; without a default, it is required."""
    part = find_child(element, tag)
    if part is None:
        if default is None:
            raise ElementError(element, f"has no <{tag}>; the specification requires it.")
        return default
    return read_numbers(part, count)


def read_child_vector(element: Element, tag: str, default: Vector3 | None = None) -> Vector3:
    """Read a child with three finite numbers; without a default, it is required."""
    x, y, z = read_child_numbers(element, tag, 3, default)
    return x, y, z


def read_numbers(element: Element, count: int) -> tuple[float, ...]:
    """Read the finite numbers in the text of an element."""
    said = read_text(element)
    try:
        return (parse_number(said),) if count == 1 else parse_numbers(said, count)
    except ValueError as error:
        raise ElementError(element, f"says {quote(said)}: it {error}.") from None


def read_child_limit(element: Element, tag: str) -> float | None:
    """Read a limit; None if it is left out, infinite, or of magnitude 1e16 and more."""
    part = find_child(element, tag)
    if part is None or read_text(part).lower() in _INFINITE:
        return None
    (value,) = read_numbers(part, 1)
    return None if abs(value) >= _UNBOUNDED else value


def read_axis_direction(axis: Element) -> Vector3:
    """Read the unit vector of an ``<axis>``; the specification's default is z."""
    x, y, z = read_child_vector(axis, "xyz", (0.0, 0.0, 1.0))
    length = math.hypot(x, y, z)
    if length < 1e-9:
        raise ElementError(axis, f"has the direction {x:g} {y:g} {z:g}, which has length zero.")
    return (snap(x / length), snap(y / length), snap(z / length))


def read_element_pose(element: Element, remarks: ReaderWarnings) -> Pose:
    """Read a ``<pose>``, in any of the rotation formats of SDF 1.9."""
    layout = element[1].get("rotation_format", "euler_rpy")
    degrees = read_attribute_bool(element, "degrees")
    if layout not in ("euler_rpy", "quat_xyzw"):
        raise ElementError(
            element, f"has rotation_format={quote(layout)}; euler_rpy and quat_xyzw are the ones there are."
        )
    if not read_text(element):
        return Pose()
    if layout == "quat_xyzw":
        if degrees:
            raise ElementError(element, "is a quaternion in degrees; quaternions have no unit.")
        x, y, z, *xyzw = read_numbers(element, 7)
        if not poses.is_valid_quaternion(tuple(xyzw)):
            said = abbreviate(read_text(element))
            mistake = ElementError(element, f"says {said}: it has length zero, and so is no rotation.")
            remarks.repair(mistake, "nothing is turned")
        return poses.pose_from_quaternion((x, y, z), tuple(xyzw))
    x, y, z, *angles = read_numbers(element, 6)
    return poses.pose_from_rpy((x, y, z), tuple(math.radians(a) if degrees else a for a in angles))
