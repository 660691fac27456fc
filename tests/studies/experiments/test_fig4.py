"""Fig. 4 of the papers: noise, order of groups, bounds, errors of the published filter."""

import contextlib
import io
import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.cli import main
from kineverse.errors import ModelError
from kineverse_studies.experiments import Options, fig4, reproduce
from kineverse_studies.experiments.fig4.accuracy import (
    REPORTED_MEAN,
    _coordinate_errors,
    _evaluate_consistency,
    cramer_rao,
    simulate_observations,
)
from kineverse_studies.experiments.fig4.protocol import (
    LEVELS,
    FilterRun,
    PoseNoise,
    add_gaussian_noise,
    add_published_noise,
    make_observed_model,
    make_tracker,
    run_published,
)

NOISE = PoseNoise(0.1, 0.05)


@pytest.fixture(scope="module")
def kitchen():
    return make_observed_model(kv.load("kitchen"))


def errors_in(frame, noisy, true):
    """Return position and rotation vector of the errors, in axes of the frame or of the world."""
    R = true[:3, :3]
    turns = np.swapaxes(R, -1, -2) @ noisy[:, :3, :3] if frame == "own" else noisy[:, :3, :3] @ R.T
    shift = noisy[:, :3, 3] - true[:3, 3]
    return (shift @ R if frame == "own" else shift), Rotation.from_matrix(turns).as_rotvec()


@pytest.fixture(scope="module")
def pose():
    found = np.eye(4)
    found[:3, :3] = Rotation.from_rotvec([0.5, -1.0, 0.3]).as_matrix()
    found[:3, 3] = 1.0, 2.0, 3.0
    return found


def test_published_noise_is_along_and_about_the_frames_own_axes(pose):
    """Directions over a quarter of the sphere give y and z the correlation 2/π."""
    noisy = add_published_noise(np.broadcast_to(pose, (40_000, 4, 4)), NOISE, np.random.default_rng(1))
    per_axis = np.eye(3) / 3
    per_axis[1, 2] = per_axis[2, 1] = 2 / (3 * math.pi)
    for errors, sigma in zip(errors_in("own", noisy, pose), (NOISE.position, NOISE.orientation), strict=True):
        np.testing.assert_allclose(np.cov(errors, rowvar=False) / sigma**2, per_axis, atol=0.012)
        np.testing.assert_allclose(errors.mean(axis=0) / sigma, 0, atol=0.012)


def test_uniform_directions_are_uncorrelated(pose):
    many = np.broadcast_to(pose, (40_000, 4, 4))
    noisy = add_published_noise(many, NOISE, np.random.default_rng(2), "uniform")
    for errors, sigma in zip(errors_in("own", noisy, pose), (NOISE.position, NOISE.orientation), strict=True):
        np.testing.assert_allclose(np.cov(errors, rowvar=False) / sigma**2, np.eye(3) / 3, atol=0.012)
        # Amplitudes are Gaussian, so lengths have the mean of a folded normal distribution.
        assert np.linalg.norm(errors, axis=1).mean() / sigma == pytest.approx(
            math.sqrt(2 / math.pi), abs=0.01
        )


def test_gaussian_noise_is_in_the_observers_axes(pose):
    noisy = add_gaussian_noise(np.broadcast_to(pose, (40_000, 4, 4)), NOISE, np.random.default_rng(3))
    for errors, sigma in zip(
        errors_in("world", noisy, pose), (NOISE.position, NOISE.orientation), strict=True
    ):
        np.testing.assert_allclose(np.cov(errors, rowvar=False) / sigma**2, np.eye(3), atol=0.03)


def test_all_moving_frames_are_observed_and_drawers_come_first(kitchen):
    model = kitchen.model
    assert set(kitchen.frames) == {f for f in model.frames if model.fk(f).symbols}
    assert len(kitchen.symbols) == 23
    assert kitchen.turning.sum() == 8
    assert kitchen.turning[:8].tolist() == [False] * 7 + [True]


def test_first_groups_form_an_observed_model(kitchen):
    part = kitchen.first(8)
    assert part.symbols == kitchen.symbols[:8]
    assert {s for f in part.frames for s in kitchen.model.fk(f).symbols} == set(part.symbols)
    q = kitchen.configurations(np.random.default_rng(5), 3)
    np.testing.assert_array_equal(part.poses(q[:, :8]), kitchen.poses(q)[:, : len(part.frames)])


def test_the_tracker_has_no_process_noise_as_in_the_papers(kitchen):
    """The deviation stays as it is between two measurements, however long."""
    tracker = make_tracker(kitchen, NOISE)
    q = kitchen.configurations(np.random.default_rng(8), 1)
    before, after = tracker.update_poses(kitchen.poses(q)[0]), tracker.predict(1000.0)
    for symbol in kitchen.symbols:
        assert after.deviation[symbol] == pytest.approx(before.deviation[symbol], rel=1e-9)
        assert after.state[symbol] == before.state[symbol]


def test_a_model_without_moving_frames_is_refused():
    with pytest.raises(ModelError, match="Nothing moves"):
        make_observed_model(kv.Model())


def test_cramer_rao_bound_equals_that_of_the_models_jacobians(kitchen):
    noise = PoseNoise(0.05, 0.1)
    q = kitchen.configurations(np.random.default_rng(6), 2)
    expected = np.zeros_like(q)
    weight = np.diag([noise.position**-2.0] * 3 + [noise.orientation**-2.0] * 3)
    for frame in kitchen.frames:
        (speed,) = kitchen.model.speeds_of(frame)
        column = kitchen.symbols.index(speed.position)
        jacobian = kitchen.model.jacobian(frame)
        for row, x in zip(expected, q[:, column], strict=True):
            J = jacobian(dict.fromkeys(jacobian.symbols, x))
            row[column] += 25 * (J.T @ weight @ J)[0, 0]
    np.testing.assert_allclose(cramer_rao(kitchen, q, noise), 1 / expected, rtol=1e-6)


@pytest.mark.parametrize("seeds", [1, pytest.param(4, marks=pytest.mark.long)])
def test_the_published_filter_is_within_5_percent_of_the_authors_code(seeds, published):
    """Compare mean errors over all seeds, on the papers' kitchen with their noise."""
    scene = make_observed_model(
        kv.load(published("iai_kitchen", "iai_kitchen", "urdf_obj", "IAI_kitchen.urdf"))
    )
    for noise, reported in zip(LEVELS, REPORTED_MEAN, strict=True):
        means = []
        for seed in range(seeds):
            truth, seen, training = simulate_observations(scene, noise, seed, 150)
            means.append(np.abs(run_published(scene, seen, training).q - truth).mean())
        assert np.mean(means) == pytest.approx(reported, rel=0.05)


def test_consistency_statistics_of_known_errors(kitchen):
    """NEES is 1 if errors match the covariance, and 9 if deviations are a third of them."""
    rng = np.random.default_rng(7)
    truth = kitchen.configurations(rng, 400)
    bound = cramer_rao(kitchen, truth, PoseNoise(0.01, 0.02))
    q = truth + rng.normal(0, np.sqrt(bound))
    consistent = _evaluate_consistency(kitchen, truth, bound, [FilterRun(q, bound, nis=1010.0, dof=1000)])
    assert consistent.nees_inside == pytest.approx(1, abs=0.05)
    assert consistent.over_bound == pytest.approx(1, abs=0.03)
    assert consistent.rms == pytest.approx(consistent.bound, rel=0.04)
    assert consistent.nis == pytest.approx(1.01)
    assert consistent.nis_band == pytest.approx((1 - 1.96 * math.sqrt(0.002), 1 + 1.96 * math.sqrt(0.002)))
    lower, upper = kitchen.limits.T
    near = np.minimum(truth - lower, upper - truth) < 3 * np.sqrt(bound)
    assert consistent.states == (~near).sum() < truth.size
    overconfident = _evaluate_consistency(kitchen, truth, bound, [FilterRun(q, bound / 9)])
    assert overconfident.nees == pytest.approx(9 * consistent.nees)
    assert "nis" not in overconfident.as_data()


def test_lost_runs_are_counted_and_excluded():
    q = np.array([[0.5], [math.nan], [0.7], [math.nan]])
    found = _coordinate_errors(FilterRun(q, np.full((4, 1), 0.01)), np.full((4, 1), 0.6), 0)
    assert (found.mean, found.max, found.nees, found.lost_percent) == pytest.approx((0.1, 0.1, 1.0, 50.0))
    nowhere = _coordinate_errors(FilterRun(q * math.nan, q), q, 0)
    assert nowhere.lost_percent == 100
    assert math.isnan(nowhere.mean)


@pytest.fixture(scope="module")
def cupboard(tmp_path_factory):
    """Return the document of a door and a drawer."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.5))
        edit.apply(kv.Prismatic(name="drawer", parent="world", child="drawer", lower=0, upper=0.4))
    path = tmp_path_factory.mktemp("fig4") / "cupboard.kv.json"
    model.save(path)
    return path


@pytest.fixture(scope="module")
def few():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fig4.protocol, "CONFIGURATIONS", 30)
        patch.setattr(fig4, "TIMED", 1)
        yield


@pytest.fixture(scope="module")
def report(cupboard, few):
    return reproduce("fig4", options=Options(quick=True, model=str(cupboard)))


@pytest.mark.long
def test_report_has_all_measurements(report):
    numbers = json.loads(json.dumps(dict(report.numbers), allow_nan=False))
    assert numbers == report.numbers
    assert numbers["symbols"] == ["drawer", "door"]
    assert (numbers["seeds"], numbers["configurations"]) == ([0], 3)
    assert [level["reported_mean"] for level in numbers["errors"]] == list(REPORTED_MEAN)
    for level in numbers["errors"]:
        for who in ("published", "proper"):
            assert 0 < level[who]["mean"] < level[who]["max"]
    sizes = numbers["by_degrees_of_freedom"]
    assert [size["degrees_of_freedom"] for size in sizes] == [1, 2]
    assert sizes[-1]["proper"]["errors"][0]["mean"] == numbers["errors"][0]["proper"]["mean"]
    assert sizes[0]["published"]["milliseconds"]["updates"] == 24
    assert [round(math.degrees(c["orientation"])) for c in numbers["consistency"]] == [1, 5, 10]
    for level in numbers["consistency"]:
        assert {"nees_inside", "nees_all", "nis", "nis_band", "rmse_over_cramer_rao"} <= set(level["proper"])
    assert len({m["mechanism"] for m in numbers["mechanisms"]}) == 3


@pytest.fixture(scope="module")
def commanded(cupboard, few):
    """Return what the command prints, and the numbers of its report."""
    reports, printed = [], io.StringIO()

    def remember(*args, **options):
        reports.append(reproduce(*args, **options))
        return reports[-1]

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr("kineverse_studies.experiments.reproduce", remember)
        assert main(["reproduce", "fig4", "--quick", "--no-figure", "--model", str(cupboard)]) == 0
    return printed.getvalue(), reports[0].numbers


@pytest.mark.long
def test_experiment_is_deterministic(report, commanded):
    """Last digits may differ, because compiled code may be ready earlier."""
    _, again = commanded
    for key in ("errors", "variants", "consistency", "mechanisms"):
        assert leaves(again[key]) == pytest.approx(leaves(report.numbers[key]), rel=1e-6)


def leaves(value):
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    if inside is None:
        return [value] if isinstance(value, float) else []
    return [number for part in inside for number in leaves(part)]


@pytest.mark.long
def test_the_figure_is_drawn(report, tmp_path):
    pytest.importorskip("matplotlib")
    report.figure.save(tmp_path / "fig4.png")
    assert (tmp_path / "fig4.png").stat().st_size > 20_000


def test_the_command_prints_tables_about_any_model(commanded):
    printed, _ = commanded
    for part in ("Tracking 2 degrees of freedom", "authors' code", "NEES", "Cramér-Rao", "folding door"):
        assert part in printed


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--model", "nowhere.urdf"], "nowhere.urdf"),
        (["--data", "."], "'fig4' takes no --data. It takes --quick, --model"),
    ],
)
def test_invalid_arguments_are_errors_of_one_line(words, says, capsys):
    assert main(["reproduce", "fig4", *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
