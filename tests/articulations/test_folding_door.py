"""The folding door against the authors' table, and against the equations of its four-bar."""

from __future__ import annotations

import math

import numpy as np
import pytest
from articulation_checks import assert_rows_keep_limits, model_of
from mechanism_cases import WHERE, pose, refused

import kineverse as kv

nan = float("nan")
DOOR = kv.articulations.FoldingDoor(**WHERE)
q = kv.position("m")

# (x, z) of upper panel, lower panel and handle; 180° less the angle between the panels.
TABLE = [
    (0.00, (-0.1833, 0.1793), (-0.1816, -0.1806), (-0.1887, -0.2792), 179.51),
    (0.46, (-0.2574, 0.1956), (-0.3318, -0.1410), (-0.3301, -0.2398), 147.99),
    (0.92, (-0.3166, 0.2431), (-0.4558, -0.0326), (-0.4501, -0.1312), 119.38),
    (1.38, (-0.3485, 0.3119), (-0.5195, 0.1224), (-0.5107, 0.0240), 91.16),
    (1.84, (-0.3466, 0.3877), (-0.5057, 0.2926), (-0.4923, 0.1947), 62.15),
]


def planar(part: str, angle: float, door: kv.articulations.FoldingDoor = DOOR) -> np.ndarray:
    return pose(door, part, {"m": angle})[[0, 2], 3]


@pytest.mark.parametrize(("angle", "upper", "lower", "handle", "between"), TABLE)
def test_folding_door_matches_the_published_table(
    angle: float,
    upper: tuple[float, ...],
    lower: tuple[float, ...],
    handle: tuple[float, ...],
    between: float,
) -> None:
    for part, expected in (("upper_panel", upper), ("lower_panel", lower), ("handle", handle)):
        np.testing.assert_allclose(planar(part, angle), expected, atol=1e-4)
    outward = [-pose(DOOR, part, {"m": angle})[:3, 0] for part in ("upper_panel", "lower_panel")]
    assert 180 - math.degrees(math.acos(outward[0] @ outward[1])) == pytest.approx(between, abs=6e-3)


def test_arm_connects_cupboard_and_lower_panel_at_every_angle() -> None:
    for angle in np.linspace(0, 1.84, 37):
        arm = pose(DOOR, "arm", {"m": angle})
        np.testing.assert_allclose(arm[[0, 2], 3], DOOR.arm_pivot, atol=1e-15)
        end = arm @ [0, 0, DOOR.arm, 1]
        np.testing.assert_allclose(end[:3], pose(DOOR, "arm_end", {"m": angle})[:3, 3], atol=1e-14)


def test_panels_are_rigid_and_share_a_hinge() -> None:
    for angle in np.linspace(0, 1.84, 13):
        e1, e2 = np.array([-np.sin(angle), -np.cos(angle)]), np.array([-np.cos(angle), np.sin(angle)])
        hinge = np.array(DOOR.top_hinge) + 0.37012 * e1 + 0.00039 * e2
        np.testing.assert_allclose(planar("panel_hinge", angle), hinge, atol=1e-14)
        lower = pose(DOOR, "lower_panel", {"m": angle})
        f1, f2 = -lower[[0, 2], 2], -lower[[0, 2], 0]
        np.testing.assert_allclose(f2, [f1[1], -f1[0]], atol=1e-14)
        np.testing.assert_allclose(hinge + 0.15621 * f1 - 0.0031 * f2, lower[[0, 2], 3], atol=1e-14)
        np.testing.assert_allclose(hinge + 0.17871 * f1 - 0.0671 * f2, planar("arm_end", angle), atol=1e-14)
    np.testing.assert_allclose(-pose(DOOR, "lower_panel", {"m": 0.0})[[0, 2], 2], [0.009, -1], atol=5e-4)


def test_folding_door_opens_at_its_speed_limit() -> None:
    model = model_of(DOOR)
    assert model.limits("m") == (0.0, 1.84)
    assert model.limits("m:velocity") == (-0.25, 0.25)
    end = assert_rows_keep_limits(model, {q: 0.0}, {"m:velocity": 1.0}, 100, 0.1)
    assert end[q] == pytest.approx(1.84)


def test_folding_door_of_another_size_is_similar() -> None:
    """Twice as large, everything is twice as far away."""
    fields = ("size", "panel", "top_hinge", "arm_pivot", "upper_middle", "panel_hinge", "lower_middle")
    fields += ("arm_end", "handle", "handle_size")
    double = {name: tuple(2 * v for v in getattr(DOOR, name)) for name in fields}
    large = kv.articulations.FoldingDoor(**WHERE, **double, arm=2 * DOOR.arm, wall=2 * DOOR.wall)
    for angle in (0.0, 0.7, 1.84):
        for part in ("upper_panel", "lower_panel", "handle", "arm_end"):
            np.testing.assert_allclose(planar(part, angle, large), 2 * planar(part, angle), atol=1e-14)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"arm": 0.1}, "The arm of the folding door 'm', 0.1, does not reach at "),
        ({"arm": 0.6}, "The arm of the folding door 'm', 0.6, does not reach at "),
        ({"opening": kv.Limits(0, 3.1)}, "The arm of the folding door 'm', 0.372, does not reach at "),
        (
            {"opening": kv.Limits(0, None)},
            "The opening of the folding door 'm' has a number as its upper end",
        ),
        ({"opening": kv.Limits(0, kv.position("x"))}, "has a number as its upper end, not x"),
        ({"opening": kv.Limits(1, 0)}, "The limits of 'm' are no range"),
        ({"arm_end": (0, 0)}, "The arm end of the folding door 'm' is at (0, 0)"),
        ({"panel_hinge": (0, 0)}, "The panel hinge of the folding door 'm' is at (0, 0)"),
        (
            {"arm_pivot": (0, nan)},
            "The arm pivot of the folding door 'm', each of it, is a finite number, not nan",
        ),
        ({"arm_pivot": (0, 0, 0)}, "has 2 numbers, which (0, 0, 0) has not"),
        ({"arm_pivot": 3}, "has 2 numbers, which 3 has not"),
        ({"size": (0.3, 0, 0.7)}, "each of it, is a positive, finite number, not 0"),
        ({"panel": (0.3, -0.1, 0.7)}, "not -0.1"),
        ({"wall": 0}, "The wall of the folding door 'm' is a positive, finite number, not 0"),
    ],
)
def test_folding_door_that_cannot_close_is_refused(given: dict[str, object], words: str) -> None:
    assert words in refused(kv.articulations.FoldingDoor, given)


def test_arm_that_does_not_reach_at_an_inner_angle_is_refused() -> None:
    """The ends are within reach, and the farthest angle in between is not."""
    u, v = DOOR.panel_hinge
    (ax, az), (dx, dz) = DOOR.top_hinge, DOOR.arm_pivot
    c = math.hypot(*DOOR.arm_end)

    def distance(angle: float) -> float:
        x = ax - u * math.sin(angle) - v * math.cos(angle) - dx
        return math.hypot(x, az - u * math.cos(angle) + v * math.sin(angle) - dz)

    for opening in ((0.0, 1.84), (-1.2, 0.2)):
        angles = np.linspace(*opening, 2001)
        distances = np.array([distance(a) for a in angles])
        least, most = distances.min(), distances.max()
        for arm in np.linspace(0.05, 0.8, 31):
            closes = bool(abs(c - arm) < least and most < c + arm)
            try:
                kv.articulations.FoldingDoor(**WHERE, arm=float(arm), opening=kv.Limits(*opening))
            except kv.errors.InvalidValueError:
                assert not closes
            else:
                assert closes


def test_spring_torque_changes_sign_at_the_tipping_angle() -> None:
    model = model_of(DOOR)
    assert dict(model.articulations["m"].dynamics) == {"spring/stiffness": 4.0, "spring/tipping": 0.6}
    torque = model.data["m/spring"]
    assert [float(torque({"m": q})) for q in (0.0, 0.6, 1.84)] == pytest.approx([-2.4, 0.0, 4.96])
    # The point between is one that the door leaves: the torque grows with the angle.
    assert float(torque.jacobian([kv.position("m")])({"m": 0.6}).item()) == 4.0
    for given, words in (
        ({"stiffness": 0}, "The stiffness of the folding door 'm' is a positive, finite number, not 0"),
        ({"tipping": math.nan}, "The tipping of the folding door 'm' is a finite number, not nan"),
    ):
        assert words in refused(kv.articulations.FoldingDoor, given)
