"""Settings of sensors: noise, rate, delay, dropouts, outliers and visibility."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from kineverse._checks import check_flag, finite_number
from kineverse._names import match_names
from kineverse.errors import DuplicateNameError, InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.model.frame import WORLD

from .robot import Robot

NEAR = 0.5  # distance from the camera within which the noise of positions is constant [m]

EXAMPLE = "3mm+3mm/m,0.5deg,30Hz,drop=0.1,outliers=0.05,delay=30ms"


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Settings of the sensors of a robot; without any, readings are exact and nothing is hidden.

    A camera at the distance d from a marker [m] reads its position with the standard deviation
    ``position + position_per_metre * max(0, d - 0.5)`` in each coordinate. The noise of orientations is a
    Gaussian rotation vector. Both are as in :mod:`kineverse.estimation.noise`.

    Attributes
    ----------
    position
        Standard deviation of each coordinate of a marker's position [m].
    position_per_metre
        Increase of this deviation with the distance beyond 0.5 m [m]/[m].
    orientation
        Standard deviation of each component of the rotation vector [rad].
    rate
        Rate of the camera [Hz].
    drop
        Probability with which a visible marker is not seen.
    outliers
        Probability with which a marker's pose is uniform in a cube about the marker, with any orientation.
    reach
        Edge of the cube [m].
    delay
        Time from all readings to their arrival [s].
    encoders
        Standard deviation of the encoders of joints [m], [rad].
    odometry
        Standard deviation of the base's position after one metre, or one radian, of motion [m]. The variance
        grows with the distance.
    turn
        Standard deviation of the base's heading after one metre, or one radian, of motion [rad].
    touch
        Whether the bodies of the robot have touch sensors.
    touch_gap
        Largest gap that a touch sensor reports, in a world without forces [m].
    touch_force
        Smallest force that a touch sensor reports [N].
    camera
        Frame of the camera, x forward; by default a frame of the robot that is named like a head or a camera.
    field_of_view
        Angle of the cone about the camera's x axis that it sees [rad]; None to see all around.
    sight
        Whether bodies hide markers behind them; needs the extra ``geometry``.
    marked
        Frames with markers; by default the bodies of articulated objects, and the bodies that carry them.
    hidden
        Frames whose markers are not seen, as if somebody had covered them.

    Raises
    ------
    InvalidValueError
        For negative and non-finite numbers, probabilities above 1, a rate of 0, an angle above 2 pi.

    Examples
    --------
    >>> sensors = kv.worlds.Sensors(position=0.003, orientation=np.radians(0.5), rate=30)
    >>> sensors.position_noise(np.array([0.5, 2.0]))
    array([0.003, 0.003])
    """

    position: float = 0.0
    position_per_metre: float = 0.0
    orientation: float = 0.0
    rate: float = 30.0
    drop: float = field(default=0.0, metadata={"most": 1.0})
    outliers: float = field(default=0.0, metadata={"most": 1.0})
    reach: float = 2.0
    delay: float = 0.0
    encoders: float = 0.0
    odometry: float = 0.0
    turn: float = 0.0
    touch: bool = True
    touch_gap: float = 1e-4
    touch_force: float = 0.5
    camera: str | None = None
    field_of_view: float | None = field(default=None, metadata={"most": 2.0 * math.pi})
    sight: bool = False
    marked: tuple[str, ...] | None = None
    hidden: frozenset[str] = frozenset()

    _POSITIVE: ClassVar = ("rate", "reach", "field_of_view")

    def __post_init__(self) -> None:
        for one in fields(self):
            given = getattr(self, one.name)
            if isinstance(one.default, bool):
                check_flag(one.name, given)
            elif isinstance(one.default, float) or (one.name == "field_of_view" and given is not None):
                self._check_number(one.name, given, one.metadata.get("most", math.inf))
        if self.camera is not None and not isinstance(self.camera, str):
            raise InvalidValueError(f"camera= is the name of a frame, not {self.camera!r}.")
        if self.marked is not None:
            object.__setattr__(self, "marked", self._names("marked"))
        object.__setattr__(self, "hidden", frozenset(self._names("hidden")))

    def _names(self, field: str) -> tuple[str, ...]:
        given = getattr(self, field)
        names = (given,) if isinstance(given, str) else tuple(given)
        if not all(isinstance(name, str) for name in names):
            raise InvalidValueError(f"{field}= takes names of frames, not {given!r:.80}.")
        return names

    def _check_number(self, name: str, given: Any, most: float) -> None:
        number = finite_number(given)
        positive = name in self._POSITIVE
        if number is None or number < 0.0 or number > most or (positive and number == 0.0):
            least = "a positive finite number" if positive else "a finite number from 0"
            limit = f" to {most:.4g}" if math.isfinite(most) else ""
            raise InvalidValueError(f"{name}= is {least}{limit}, not {given!r}.")
        object.__setattr__(self, name, number)

    def find_frames(self, robot: Robot) -> tuple[str, tuple[str, ...]]:
        """Return the frame of a robot's camera, and those of the markers that it may see.

        Without any that is named like a camera, the first frame of the robot stands in for it.

        Raises
        ------
        UnknownNameError
            For frames that the model does not have.
        """
        camera = self.camera or robot.camera or next(iter(robot.frames), WORLD)
        marked = robot.markers if self.marked is None else self.marked
        frames = robot.model.frames
        known = [*frames, WORLD]
        match_names((camera, *sorted(self.hidden)), known, "frame")
        return camera, match_names(marked, known, "frame")

    def position_noise(self, distance: Array) -> Array:
        """Return the standard deviation of each coordinate at distances (...) from the camera [m]."""
        return self.position + self.position_per_metre * np.maximum(0.0, distance - NEAR)

    def pose_noise(self, distances: npt.ArrayLike, position: float, orientation: float) -> Array:
        """Return the standard deviations (2, ...) of positions and orientations at distances from the camera.

        They are ``position`` [m] and ``orientation`` [rad] at least: no camera is exact.
        """
        positions = np.maximum(self.position_noise(np.asarray(distances)), position)
        return np.array([positions, np.full_like(positions, max(self.orientation, orientation))])

    @classmethod
    def parse(cls, text: str) -> Sensors:
        """Return the settings that a text states, such as ``3mm+3mm/m,0.5deg,30Hz,drop=0.1,delay=30ms``.

        Entries are separated by commas. Without a name they are the noise of positions (``3mm``, and
        ``+3mm/m`` for its increase with the distance), that of orientations (``0.5deg``), and the rate
        (``30Hz``). The others are ``drop``, ``outliers``, ``reach``, ``delay``, ``encoders``, ``odometry``,
        ``turn``, ``touch_gap``, ``touch_force``, ``camera`` and ``fov``, and the words ``sight`` and
        ``notouch``. ``none`` stands for exact sensors.

        Raises
        ------
        InvalidValueError
            For an entry that cannot be read.
        UnknownNameError
            For an unknown name, with the known ones.
        DuplicateNameError
            If something is stated twice.

        Examples
        --------
        >>> kv.worlds.Sensors.parse("3mm+3mm/m,0.5deg,30Hz,drop=0.1").drop
        0.1
        """
        if not isinstance(text, str):
            raise InvalidValueError(f"Sensors are stated by a text such as {EXAMPLE!r}, not by {text!r}.")
        result: dict[str, Any] = {}
        entries = [] if text.strip() in ("", "none") else text.split(",")
        for entry in map(str.strip, entries):
            for name, value in _parse_entry(entry):
                if name in result:
                    raise DuplicateNameError(f"Noise {text!r} states '{name}' twice, again in {entry!r}.")
                result[name] = value
        return cls(**result)

    def __str__(self) -> str:
        """Return the settings as a text that :meth:`parse` reads, without marked and hidden frames."""
        parts: list[str] = []
        if self.position or self.position_per_metre:
            more = f"+{self.position_per_metre * 1e3:.12g}mm/m" if self.position_per_metre else ""
            parts.append(f"{self.position * 1e3:.12g}mm{more}")
        if self.orientation:
            parts.append(f"{math.degrees(self.orientation):.12g}deg")
        parts.append(f"{self.rate:.12g}Hz")
        exact = Sensors()
        for key, (name, unit) in _NAMED.items():
            value = getattr(self, name)
            if value != getattr(exact, name):
                scaled = value if unit is None else value / _UNITS[unit][1]
                parts.append(f"{key}={value}" if unit is None else f"{key}={scaled:.12g}{unit}")
        parts += [word for word, (name, value) in _WORDS.items() if getattr(self, name) is value]
        return ",".join(parts)


_UNITS = {
    "mm": ("length", 1e-3), "cm": ("length", 1e-2), "m": ("length", 1.0), "mm/m": ("slope", 1e-3),
    "cm/m": ("slope", 1e-2), "m/m": ("slope", 1.0), "deg": ("angle", math.pi / 180.0),
    "°": ("angle", math.pi / 180.0), "rad": ("angle", 1.0), "Hz": ("rate", 1.0), "ms": ("time", 1e-3),
    "s": ("time", 1.0), "%": ("number", 1e-2), "": ("number", 1.0),
}  # fmt: skip
"""Units with their dimension and factor."""

_NAMED: dict[str, tuple[str, str | None]] = {
    "drop": ("drop", ""), "outliers": ("outliers", ""), "reach": ("reach", "m"), "delay": ("delay", "ms"),
    "encoders": ("encoders", ""), "odometry": ("odometry", "mm/m"), "turn": ("turn", "deg"),
    "touch_gap": ("touch_gap", "mm"), "touch_force": ("touch_force", ""), "camera": ("camera", None),
    "fov": ("field_of_view", "deg"),
}  # fmt: skip
"""Names of entries: the setting, and the unit in which it is printed; None for text."""

_WORDS = {"sight": ("sight", True), "notouch": ("touch", False)}

_UNNAMED = {"length": "position", "slope": "position_per_metre", "angle": "orientation", "rate": "rate"}

_ENTRY = re.compile(r"(?P<number>[0-9]+\.?[0-9]*(?:[eE][-+]?[0-9]+)?|\.[0-9]+)\s*(?P<unit>[A-Za-z°%/]*)")


def _parse_entry(entry: str) -> list[tuple[str, Any]]:
    if entry in _WORDS:
        return [_WORDS[entry]]
    key, equals, value = (part.strip() for part in entry.partition("="))
    if not equals:
        if entry and entry.replace("_", "").isalpha():
            raise UnknownNameError(
                f"Noise {entry!r} is unknown. {suggest(entry, (*_NAMED, *_WORDS), 'entry')}"
            )
        result = [_parse_quantity(part.strip(), entry) for part in re.split(r"(?<![eE])\+", entry)]
        for kind, _ in result:
            if kind not in _UNNAMED or (len(result) > 1 and kind not in ("length", "slope")):
                raise _unreadable(entry)
        return [(_UNNAMED[kind], number) for kind, number in result]
    if key not in _NAMED:
        raise UnknownNameError(f"Noise {entry!r}: there is no '{key}'. {suggest(key, _NAMED, 'entry')}")
    name, unit = _NAMED[key]
    if unit is None:
        return [(name, value)]
    kind, number = _parse_quantity(value, entry)
    wanted = {_UNITS[unit][0]} | _ALSO.get(key, set())
    if kind not in wanted:
        example = f"{key}=5{unit}" if unit else f"{key}=0.1"
        raise InvalidValueError(f"Noise {entry!r}: '{value}' is of another kind; write such as {example}.")
    return [(name, number)]


_ALSO = {"encoders": {"angle", "length"}}  # encoders read lengths and angles alike


def _parse_quantity(text: str, entry: str) -> tuple[str, float]:
    match = _ENTRY.fullmatch(text)
    if match is None or match["unit"] not in _UNITS:
        raise _unreadable(entry)
    kind, factor = _UNITS[match["unit"]]
    return kind, float(match["number"]) * factor


def _unreadable(entry: str) -> InvalidValueError:
    units = ", ".join(unit for unit in _UNITS if unit)
    return InvalidValueError(
        f"Noise {entry!r} is not readable. Write entries such as {EXAMPLE}; units are {units}."
    )
