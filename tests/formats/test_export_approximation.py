"""Approximation of motions within a tolerance: error bounds hold, and are close to the errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from round_trip import compile_poses, random_values

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import TermGraph
from kineverse.intervals.taylor import taylor_variable
from kineverse.model.registry import FrameDeviation

Q = kv.position("q")
CURVES = [
    np.sin(Q) * np.cos(2 * Q),
    np.arctan(Q**3 + 1) - np.tan(Q / 3),
    np.arcsin(Q / 3) + np.arccos(Q / 2),
    np.sqrt(4 + Q) / (3 + Q),
    np.exp(Q) * np.log(3 + Q),
    np.arctan2(1 + Q, 2 - Q) + np.arctan2(np.sin(Q) + 3, -Q),
    (Q + 3) ** 2.5 - (Q + 3) ** -2,
    kv.spline(Q, [-2, -0.3, 0.4, 2], [0, 1, 0.2, 0.5]),
    kv.spline(Q, [0, 0.5, 1.5], [0.3, 1, 0.3], periodic=True),
    np.minimum(Q, Q**2) + abs(Q),
]


def limited(name: str, coordinate: str, lower: float, upper: float) -> kv.Model:
    """Return a scene one coordinate of which has limits."""
    model = kv.load(f"articulations/{name}")
    with model.edit() as edit:
        edit.constrain(f"limits of {coordinate}", lower, model.symbol(coordinate), upper)
    return model


def sampled_errors(model: kv.Model, read: kv.Model, count: int = 60) -> dict[str, FrameDeviation]:
    """Return the largest errors met at random configurations and at the ends of all limits."""
    rng, frames = np.random.default_rng(0), list(model.frames)
    found = dict.fromkeys(frames, FrameDeviation())
    ours, theirs = compile_poses(model, frames), compile_poses(read, frames)
    for k in range(count):
        values = random_values(model, rng)
        if k < 2:
            ends = {s: model.limits(s)[k] for s in values}
            values = {s: ends[s] if abs(ends[s]) < 9 else v for s, v in values.items()}
        for name, a, b in zip(frames, ours(values), theirs(values), strict=True):
            chord = np.linalg.norm(a[:3, :3] - b[:3, :3]) / np.sqrt(8)  # that is sin(angle / 2)
            angle = 2 * np.arcsin(min(1.0, chord))
            distance, before = float(np.linalg.norm(a[:3, 3] - b[:3, 3])), found[name]
            found[name] = FrameDeviation(max(before.position, distance), max(before.angle, float(angle)))
    return found


@pytest.mark.parametrize("curve", CURVES, ids=[f"curve{k}" for k in range(len(CURVES))])
@settings(max_examples=attempts(8), deadline=None)
@given(low=st.floats(-1, 1), width=st.floats(1e-3, 0.3), part=st.floats(0, 1))
def test_taylor_series_enclose_the_function_and_the_series_at_all_points(
    curve: kv.Expression, low: float, width: float, part: float
) -> None:
    terms = TermGraph({})
    enclosures, term = Enclosures(terms), terms.term(curve)
    at = min(low + width, max(low, low + part * width))
    (whole,) = enclosures.enclose([term], {Q: taylor_variable((low, low + width))})
    (point,) = enclosures.enclose([term], {Q: taylor_variable((at, at))})
    value = float(curve({Q: at}))
    assert whole[0][0] - 1e-12 <= value <= whole[0][1] + 1e-12
    for here, everywhere in zip(point, whole, strict=False):
        # The ends are rounded like all numbers.
        slack = 1e-12 * max(1.0, *map(abs, here))
        assert everywhere[0] - slack <= here[0]
        assert here[1] <= everywhere[1] + slack
    step = 1e-3
    (around,) = enclosures.enclose([term], {Q: taylor_variable((at - step, at + step))})
    if len(around) > 3:  # smooth there: the series is that of Taylor
        near = sum((a + b) / 2 * step**k for k, (a, b) in enumerate(point))
        assert float(curve({Q: at + step})) == pytest.approx(near, abs=1e-8)


def test_taylor_series_enclose_implicit_functions() -> None:
    model = kv.load("articulations/four_bar")
    terms = TermGraph({})
    enclosures, crank = Enclosures(terms), model.symbol("four_bar/crank")
    for follower in model.rates.dependent.values():
        (whole,) = enclosures.enclose([terms.term(follower)], {crank: taylor_variable((0.5, 0.51))})
        values = [float(follower({crank: x})) for x in np.linspace(0.5, 0.51, 9)]
        assert whole[0][0] <= min(values)
        assert max(values) <= whole[0][1]
        slopes = np.diff(values) / np.diff(np.linspace(0.5, 0.51, 9))
        assert whole[1][0] <= slopes.min()
        assert slopes.max() <= whole[1][1]
        assert whole[0][1] - whole[0][0] < 0.1


CASES = {
    "urdf": [
        ("mimic", lambda: kv.load("articulations/mimic"), 0.1),
        ("cam", lambda: limited("cam", "cam/cam", 0.2, 1.5), 0.01),
        ("folding_door", lambda: kv.load("articulations/folding_door"), 0.05),
        ("piston", lambda: limited("piston", "piston/engine", -0.5, 0.5), 0.01),
        ("pedal_bin", lambda: kv.load("articulations/pedal_bin"), 0.1),
        ("slider_crank", lambda: limited("slider_crank", "slider_crank/crank", 0.2, 1.0), 0.05),
    ],
    "xml": [
        ("cam", lambda: limited("cam", "cam/cam", 0.2, 1.5), 0.001),
        ("folding_door", lambda: kv.load("articulations/folding_door"), 0.005),
        ("piston", lambda: limited("piston", "piston/engine", -0.5, 0.5), 1e-4),
        ("pedal_bin", lambda: kv.load("articulations/pedal_bin"), 0.01),
    ],
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("ending", "build", "tolerance"),
    [pytest.param(e, b, t, id=f"{n}.{e}") for e, cases in CASES.items() for n, b, t in cases],
)
def test_error_bounds_hold_and_are_tight(
    ending: str, build: object, tolerance: float, tmp_path: Path
) -> None:
    model = build()  # type: ignore[operator]
    file = tmp_path / f"m.{ending}"
    with pytest.raises(kv.errors.FormatError):
        model.save(file)
    report = model.save(file, tolerance=tolerance)
    assert 0 < max(report.error.position, report.error.angle) <= tolerance
    read = kv.load(file)
    assert read.degrees_of_freedom == model.degrees_of_freedom
    for name, error in sampled_errors(model, read).items():
        promised = report.errors.get(name, FrameDeviation())
        assert error.position <= promised.position + 1e-12, name
        assert error.angle <= promised.angle + 1e-7, name  # an arc sine of rounding
        # A thousandth of the tolerance is not made sure of any further.
        assert promised.position <= 3 * error.position + tolerance / 500 + 1e-12, name
        assert promised.angle <= 3 * error.angle + tolerance / 500 + 1e-12, name
    worst = max(report.errors, key=lambda name: report.errors[name].position)
    assert f"approximated: '{worst}' is off by {report.errors[worst]} at most" in file.read_text()


def test_exact_motions_have_no_error(tmp_path: Path) -> None:
    report = kv.load("articulations/desk_lamp").save(tmp_path / "m.urdf", tolerance=1e-3)
    assert report.errors == {}
    assert report.error == FrameDeviation()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pedal_bin", r"'pedal_bin/bin/lid' moves by a curve over .* is off by 0\.07\d+ rad"),
        ("four_bar", "'four_bar/crank', which has no limits between which it is approximated"),
    ],
)
def test_tolerance_that_cannot_be_met_is_refused_with_the_least_error(
    name: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(kv.errors.FormatError, match=message):
        kv.load(f"articulations/{name}").save(tmp_path / "m.urdf", tolerance=1e-3)
    assert not list(tmp_path.iterdir())


def test_curves_over_two_coordinates_are_refused(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        for name in ("q", "p"):
            edit.apply(kv.Revolute(name=name, parent="world", child=name, lower=0, upper=1))
        edit.apply(kv.Revolute(name="b", parent="q", child="b", position=Q * kv.position("p")))
    with pytest.raises(kv.errors.FormatError, match="'b' moves by a curve over several coordinates, p, q"):
        model.save(tmp_path / "m.urdf", tolerance=0.1)


def test_frame_errors_grow_with_the_distance_from_the_approximated_joint(tmp_path: Path) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="q", lower=0, upper=1))
        bend = Q + 0.05 * np.sin(3 * Q)
        edit.apply(kv.Revolute(name="bend", parent="world", child="bend", axis=(0, 0, 1), position=bend))
        edit.add_frame("near", parent="bend", transform=kv.translation(0.1, 0, 0))
        edit.add_frame("far", parent="near", transform=kv.translation(1.9, 0, 0))
    report = model.save(tmp_path / "m.urdf", tolerance=0.2)
    assert report.errors["bend"].position == 0
    assert report.errors["far"].position / report.errors["near"].position == pytest.approx(20)
    with pytest.raises(kv.errors.FormatError, match="'far' would be off by up to"):
        model.save(tmp_path / "m.urdf", tolerance=report.errors["far"].position * 0.9)
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name="rail", parent="bend", child="rail"))
    with pytest.raises(kv.errors.FormatError, match="'rail' is carried by something approximated"):
        model.save(tmp_path / "m.urdf", tolerance=0.2)


def test_limits_of_approximated_joints_are_implied_or_left_out(tmp_path: Path) -> None:
    def model(upper: float) -> kv.Model:
        result = kv.Model()
        with result.edit() as edit:
            edit.apply(kv.Revolute(name="q", parent="world", child="q", lower=0, upper=1, velocity=2))
            bend = Q + 0.05 * np.sin(3 * Q)
            edit.apply(kv.Revolute(name="b", parent="q", child="b", position=bend, upper=upper, velocity=3))
        return result

    report = model(1.1).save(tmp_path / "m.urdf", tolerance=0.1)
    assert "'b/position' is not written: it holds within the other limits" in report.remarks
    assert "'b/velocity' is not written: it holds within the other limits" in report.remarks
    with pytest.raises(kv.errors.FormatError, match="'b/position' is no multiple of one coordinate"):
        model(0.9).save(tmp_path / "m.urdf", tolerance=0.1, strict=True)
    assert list(model(0.9).save(tmp_path / "m.urdf", tolerance=0.1).left_out) == ["b/position"]


@pytest.mark.parametrize("tolerance", [0, -1, np.nan, np.inf, "small"])
def test_tolerance_that_is_not_positive_is_refused(tolerance: object, tmp_path: Path) -> None:
    with pytest.raises(kv.KineverseError, match="A tolerance is a positive number"):
        kv.Model().save(tmp_path / "m.urdf", tolerance=tolerance)


def test_documents_have_no_tolerance(tmp_path: Path) -> None:
    with pytest.raises(kv.errors.FormatError, match="exactly"):
        kv.Model().save(tmp_path / "m.kv.json", tolerance=0.1)
