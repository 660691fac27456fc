"""Garage door of the papers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from kineverse.articulations.limits import Limits
from kineverse.articulations.locks import BoundedExpression, speed_lock
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression
from kineverse.expressions.functions import arccos, cos
from kineverse.spatial import X, Y, Z, rotation_about, translation_along

from .mechanism import Mechanism, MechanismPart
from .simple_bodies import DARK, STEEL, WOOD, box_shape, rod_shape, shift


@dataclass(frozen=True, kw_only=True)
class GarageDoor(Mechanism, document_kind="GarageDoor"):
    """Garage door: the lower edge moves along a vertical rail, the upper edge along one under the ceiling.

    2022 paper, Eqs. 11-13. With the length l and the angle α, 0 when closed,

        base_T_door = translation(0, 0, l (1 - cos α)) · rotation_y(α)

    Surprise first: the coordinate is α, and not the papers' position a = l cos α, which is l when closed and
    0 when open. There α = arccos(a/l) has an infinite slope at a = l, exactly where the door is locked. With
    ``form="published"`` the coordinate is a, and the height is l - a, because the a that Eq. 12 prints is not
    0 at the floor when closed.

    =================  ==================================================================
    ``name/door``      q = α in [0, π/2] [rad], or as published q = a in [0, l] [m]
    ``name/bolt``      b, the handle of the lock [rad]
    frames             ``base``, ``door`` (lower edge, z along the door), ``upper_edge``, ``bolt``
    ``name/lock``      -speed·unlocked <= q̇ <= speed·unlocked
    unlocked           ~((b < catch) & closed), closed if a > l - play
    =================  ==================================================================

    Attributes
    ----------
    length, width, thickness
        Dimensions of the door [m].
    form
        ``"regular"``, or ``"published"`` with the coordinate of the papers.
    bolt
        Limits of b.
    catch
        Angle b below which the bolt locks [rad].
    play
        Largest distance of a from l at which the bolt still catches [m].
    speed
        Limit of |q̇| while it is unlocked [rad/s], or as published [m/s].

    Raises
    ------
    InvalidValueError
        For lengths that are not positive, a play that is not below the length, or a catch beyond the bolt's
        limits.
    """

    main: ClassVar[str] = "door"

    length: float = 2.0
    width: float = 2.5
    thickness: float = 0.04
    form: Literal["regular", "published"] = "regular"
    bolt: Limits = Limits(0.0, 0.6)
    catch: float = 0.3
    play: float = 0.01
    speed: float = 1.0

    def __post_init__(self) -> None:
        self.check_lengths("length", "width", "thickness", "play", "speed")
        if not isinstance(self.form, str) or self.form not in ("regular", "published"):
            raise InvalidValueError(
                f"{self.describe('form')} is 'regular' or 'published', not {self.form!r}."
            )
        if not self.play < self.length:
            raise InvalidValueError(
                f"{self.describe('play')} is less than its length {self.length:g}, and not {self.play:g}."
            )
        super().__post_init__()
        self.check_threshold("catch", self.bolt)

    @property
    def limits(self) -> Mapping[str, Limits]:
        """Limits of the door and of the bolt."""
        most = self.length if self.form == "published" else math.pi / 2
        return {self.path("door"): Limits(0.0, most), self.path("bolt"): self.bolt}

    @property
    def closed(self) -> Expression:
        """Condition a > l - play."""
        if self.form == "published":
            return self.q("door") > self.length - self.play
        return self.q("door") < math.acos(1 - self.play / self.length)

    def locks(self) -> Mapping[str, BoundedExpression]:
        """Return the lock, c2 of Eq. 13."""
        raised = self.q("bolt") > self.catch
        return {
            "lock": speed_lock(self.q("door"), open_if=raised, engaged_if=self.closed, max_speed=self.speed)
        }

    def parts(self) -> Mapping[str, MechanismPart]:
        """Return rails, door and bolt."""
        q, length, side = self.q("door"), self.length, self.width / 2 + 0.03
        if self.form == "published":
            height, angle = length - q, arccos(q / length)
        else:
            height, angle = length * (1 - cos(q)), q
        rails = [box_shape((0.05, 0.05, length), (0.0, y, length / 2), STEEL) for y in (-side, side)]
        rails += [box_shape((length, 0.05, 0.05), (length / 2, y, length), STEEL) for y in (-side, side)]
        leaf = box_shape((self.thickness, self.width, length), (0.0, 0.0, length / 2), WOOD)
        grip = -self.thickness / 2 - 0.04
        return {
            "base": self.base(*rails),
            "door": MechanismPart("base", (translation_along(Z, height), rotation_about(Y, angle)), (leaf,)),
            "upper_edge": MechanismPart("door", (shift(z=length),)),
            "bolt": MechanismPart(
                "door",
                (shift(grip, 0.0, 0.15 * length), rotation_about(X, self.q("bolt"))),
                (
                    rod_shape((0.0, 0.0, 0.0), (0.04, 0.0, 0.0), 0.01, DARK),
                    box_shape((0.02, 0.2, 0.02), (0, 0, 0), DARK),
                ),
            ),
        }
