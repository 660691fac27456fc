"""The simulation of the demo without a browser: motion, readings, tracking, identification and drawing."""

import math
import re

import numpy as np
import pytest
from living_kitchen.gating import OutlierGate
from living_kitchen.identify import axis_error
from living_kitchen.marker_meshes import REACH, SIGMAS, compute_axis_line, create_axis_tube, create_rod
from living_kitchen.panel import format_kitchen, format_mechanism
from living_kitchen.picture import picture
from living_kitchen.placed_model import uncertainty_color
from living_kitchen.report import tabulate_identification, tabulate_tracking
from living_kitchen.scene import SceneDrawables
from living_kitchen.sensor import MarkerSampler, SensorModel
from living_kitchen.simulation import Simulation
from living_kitchen.track import average
from living_kitchen.trajectory import PeriodicTrajectory
from living_kitchen.unknown_mechanisms import MECHANISMS
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.estimation import identify, pose_covariance
from kineverse.view.plots import axis_covariances

STEP = 1.0 / 12.0


def simulate(seconds, **options):
    """Return a simulation after some seconds, and at each step its quality and the error of the tracked part."""
    simulation, qualities, off = Simulation(**options), [], []
    simulation.kitchen_tracker.tracker.wait()  # numpy takes many times as long, and rounds otherwise
    for _ in range(round(seconds / STEP)):
        simulation.step(STEP)
        qualities.append(simulation.quality)
        off.append(simulation.part_error)
    return simulation, qualities, off


def simulate_mechanism(seconds, **options):
    """Return a simulation like that of :func:`simulate`, in which the kitchen stands still: half the work."""
    simulation, off = Simulation(**options), []
    for _ in range(round(seconds / STEP)):
        simulation.time += STEP
        simulation._move_mechanism(STEP)
        off.append(simulation.part_error)
    return simulation, off


@pytest.fixture(scope="module")
def chest():
    return simulate(10.0)


# -- motion ----------------------------------------------------------------------------------------------


def test_the_trajectory_covers_all_ranges_within_position_and_speed_limits():
    model = kv.load("kitchen")
    trajectory = PeriodicTrajectory(model)
    names, h = trajectory.names, 1e-4
    assert sorted(names) == sorted(map(str, model.degrees_of_freedom))
    reached = dict.fromkeys(names, 0.0)
    for time in np.arange(0.0, trajectory.period + 8.0, 0.15):
        now, soon = trajectory.evaluate(time), trajectory.evaluate(time + h)
        speeds = {f"{name}:velocity": (soon[name] - now[name]) / h for name in names}
        assert not list(model.violations({**now, **speeds}))
        for name in names:
            low, high = model.limits(name)
            reached[name] = max(reached[name], (now[name] - low) / (high - low))
    assert min(reached.values()) > 0.85


def test_the_trajectory_is_periodic_and_moves_a_few_joints_at_a_time():
    trajectory = PeriodicTrajectory(kv.load("kitchen"))
    for time in np.linspace(5.0, trajectory.period, 30):
        later, soon = trajectory.evaluate(time + trajectory.period), trajectory.evaluate(time + 0.1)
        now = trajectory.evaluate(time)
        assert 1 <= sum(abs(now[n] - soon[n]) > 1e-4 for n in now) <= 12
        for name in trajectory.names[:3]:
            assert later[name] == pytest.approx(now[name], abs=1e-9)


# -- readings --------------------------------------------------------------------------------------------


def test_readings_have_the_covariance_and_fractions_of_the_sensor_model():
    poses = np.tile(np.eye(4), (4000, 1, 1))
    poses[:, :3, :3] = Rotation.random(4000, random_state=1).as_matrix()
    sensor = SensorModel(0.02, outliers=0.2, hidden=0.5)
    readings = MarkerSampler(4000, 0).observe(poses, 0.0, sensor)
    good = ~readings.wrong
    turns = Rotation.from_matrix(readings.poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)).as_rotvec()
    errors = np.hstack([readings.poses[:, :3, 3], turns])[good]
    # The standard deviation of 3200 numbers is known to 1.3 %.
    np.testing.assert_allclose(errors.std(axis=0), np.sqrt(np.diag(sensor.covariance)), rtol=0.06)
    assert readings.wrong.mean() == pytest.approx(0.2, abs=0.03)
    assert readings.visible.mean() == pytest.approx(0.5, abs=0.04)
    assert np.linalg.norm(readings.poses[readings.wrong, :3, 3], axis=1).mean() > 0.3


@pytest.mark.parametrize("wrong", [{"noise": 0.0}, {"noise": math.nan}, {"outliers": 1.0}, {"hidden": -0.1}])
def test_invalid_sensor_models_are_refused(wrong):
    with pytest.raises(kv.errors.InvalidValueError, match=next(iter(wrong))):
        SensorModel(**wrong)


def test_simulations_of_equal_seeds_are_equal():
    one, two, other = (simulate(0.5, seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.readings.poses, two.readings.poses)
    assert one.kitchen_tracker.values == two.kitchen_tracker.values
    assert one.kitchen_tracker.values != other.kitchen_tracker.values


# -- tracking --------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_track_is_more_accurate_than_the_markers_and_consistent(chest):
    quality = average(chest[1][36:])
    assert quality.marker == pytest.approx(math.sqrt(3.0) * 0.03, rel=0.05)
    assert quality.mean < 0.25 * quality.marker
    assert 0.75 < quality.nees < 1.3


def test_tracking_rejects_outliers():
    simulation, qualities, _ = simulate(2.5, sensor=SensorModel(0.03, outliers=0.2))
    assert average(qualities[12:]).mean < 0.3 * math.sqrt(3.0) * 0.03
    wrong = {
        f
        for f, w, t in zip(
            simulation.kitchen_tracker.frames,
            simulation.readings.wrong,
            simulation.readings.visible,
            strict=True,
        )
        if w & t
    }
    assert wrong
    assert len(wrong.symmetric_difference(simulation.kitchen_tracker.estimate.outliers)) <= 2


@pytest.mark.long
def test_the_track_of_hidden_markers_is_consistent():
    _, qualities, _ = simulate(20.0, seed=1, sensor=SensorModel(0.03, hidden=0.5))
    assert 0.6 < average(qualities[36:]).nees < 1.5


def test_hidden_markers_become_uncertain_and_a_new_sensor_model_is_used():
    simulation, *_ = simulate(1.5)
    sure = simulation.kitchen_tracker.uncertainty_lengths()
    simulation.sensor = SensorModel(0.05, hidden=0.5)
    for _ in range(24):
        simulation.step(STEP)
    length = simulation.kitchen_tracker.uncertainty_lengths()
    assert 5 <= (~simulation.readings.visible).sum() <= 18
    assert length[~simulation.readings.visible].mean() > 3.0 * sure.mean()
    assert length[~simulation.readings.visible].mean() > 2.0 * length[simulation.readings.visible].mean()
    assert uncertainty_color(0.8) != uncertainty_color(0.05)


@pytest.mark.long
def test_uncertainty_paths_pass_the_tracked_positions_and_have_their_lengths(chest):
    kitchen_tracker = chest[0].kitchen_tracker
    ways = kitchen_tracker.uncertainty_paths()
    np.testing.assert_allclose(ways[:, 2], kitchen_tracker.positions(kitchen_tracker.values), atol=1e-12)
    lengths = np.linalg.norm(np.diff(kitchen_tracker.uncertainty_paths(3), axis=1), axis=2).sum(axis=1)
    np.testing.assert_allclose(kitchen_tracker.uncertainty_lengths(), lengths)


# -- identification --------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", ["crate", "chest", "stool"])
def test_an_unknown_mechanism_is_identified_and_then_tracked(name):
    simulation, off = simulate_mechanism(10.0, mechanism=name)
    mechanism, learner = simulation.mechanism, simulation.learner
    assert max(learner.history[0].probabilities.values()) < 0.95  # ambiguous at first
    assert not learner.result.is_ambiguous
    assert learner.result.best.family == mechanism.family
    angle, distance, sigmas = axis_error(learner.result.best, *mechanism.axis)
    assert angle < math.radians(9.0)
    assert distance < 0.06
    assert sigmas < 2.2
    # The mean error of a marker is 1.6 standard deviations of one coordinate.
    assert np.mean(off[-20:]) < 1.2 * simulation.sensor.noise


@pytest.mark.long
def test_an_unknown_mechanism_is_identified_despite_outliers():
    simulation, _ = simulate_mechanism(8.0, seed=2, sensor=SensorModel(0.03, outliers=0.2))
    best = simulation.learner.result.best
    assert (best.family, simulation.learner.result.is_ambiguous) == ("revolute", False)
    assert axis_error(best, *simulation.mechanism.axis)[0] < math.radians(9.0)


def test_the_gate_rejects_outliers_and_keeps_inliers():
    gate, markers, sensor = OutlierGate(), MarkerSampler(2, 3), SensorModel(0.03, outliers=0.2, hidden=0.3)
    missed = dropped = right = 0
    stool = MECHANISMS["stool"]()
    for k in range(60):
        poses = np.stack(stool.poses(0.5 - 0.5 * math.cos(0.1 * k)))
        readings = markers.observe(poses, k * STEP, sensor)
        good = gate.find_inliers(readings, STEP, sensor)
        assert not (good & ~readings.visible).any()
        missed += (readings.wrong & good).sum()
        right += (readings.visible & ~readings.wrong).sum()
        dropped += (readings.visible & ~readings.wrong & ~good).sum()
    assert missed == 0
    assert dropped < 0.05 * right


def test_a_changed_mechanism_restarts_identification():
    simulation, *_ = simulate(2.0)
    assert simulation.learner.result is not None
    simulation.change_mechanism()
    assert (simulation.mechanism.name, simulation.learner.result, simulation.part_error) == (
        "crate",
        None,
        None,
    )
    simulation.step(STEP)
    assert len(simulation.learner.part_positions) == 1
    with pytest.raises(kv.errors.UnknownNameError, match=r"'boat'.*chest"):
        simulation.change_mechanism("boat")
    assert simulation.mechanism.name == "crate"


def test_mechanisms_change_after_their_time():
    simulation = Simulation()
    simulation.step(39.0)
    assert simulation.mechanism.name == "chest"
    simulation.step(2.0)
    assert simulation.mechanism.name == "crate"


@pytest.mark.parametrize("name", list(MECHANISMS))
def test_the_true_axis_is_that_of_a_fit_of_exact_poses(name):
    mechanism = MECHANISMS[name]()
    poses = [mechanism.poses(q) for q in np.linspace(*mechanism.limits, 30)]
    base, part = (np.array(found) for found in zip(*poses, strict=True))
    fit = identify(base, part, noise=pose_covariance(1e-4, 1e-4))[mechanism.family]
    angle, distance, _ = axis_error(fit, *mechanism.axis)
    assert angle < 1e-6
    assert distance < 1e-6


@pytest.mark.long
def test_axis_covariances_are_those_of_sampled_axes(chest):
    fit = chest[0].learner.result.best
    index = [fit.coordinates.index(n) for n in ("point.x", "point.y", "axis.x", "axis.y")]
    covariance = fit.covariance[np.ix_(index, index)]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(4), covariance, 20_000)
    height = 0.6
    ways = Rotation.from_rotvec(np.pad(drawn[:, 2:], ((0, 0), (0, 1)))).as_matrix()[:, :, 2]
    crossings = drawn[:, :2] + height * ways[:, :2] / ways[:, 2:]
    expected, found = np.cov(crossings.T), axis_covariances(fit, np.array([height]))[0]
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


# -- drawing ---------------------------------------------------------------------------------------------


@pytest.mark.long
def test_rods_are_round_and_axis_tubes_are_two_deviations_wide(chest):
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.2], [0.2, 0.4, 0.4]])
    away = create_rod(points, 0.05).vertices - np.repeat(points, 16, axis=0)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.05)
    np.testing.assert_allclose(away @ [1.0, 2.0, 2.0], 0.0, atol=1e-12)
    fit, near = chest[0].learner.result.best, np.array([0.0, 0.1, 0.4])
    ends = compute_axis_line(fit, near)
    middle = ends.mean(axis=0)
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(2.0 * REACH)
    assert (near - middle) @ (ends[1] - ends[0]) == pytest.approx(0.0, abs=1e-12)
    ring = (create_axis_tube(fit, near).vertices.reshape(13, -1, 3)[6] - middle) @ fit.frame[:3, :2]
    above = float((middle - fit.frame[:3, 3]) @ fit.frame[:3, 2])
    squares = np.einsum("ni,ij,nj->n", ring, np.linalg.inv(axis_covariances(fit, np.array([above]))[0]), ring)
    np.testing.assert_allclose(np.sqrt(squares), SIGMAS, rtol=0.02)


@pytest.mark.long
def test_a_picture_shows_both_worlds_and_the_identified_axis(chest):
    young, simulation = Simulation(), chest[0]
    before, after = (picture(one, (500, 260)).astype(int) for one in (young, simulation))
    assert before.shape == (260, 500, 3)

    def magenta(image):
        r, g, b = np.moveaxis(image, -1, 0)
        return ((r > 140) & (g < 90) & (b > 50) & (b < 140)).sum()

    def blue(image):
        r, _, b = np.moveaxis(image, -1, 0)
        return ((b > 150) & (b > 1.8 * r)).sum()

    assert magenta(after) > 3 * magenta(before) + 50
    assert blue(after[:, 250:]) > 500
    assert blue(after[:, 250:]) > 3 * blue(after[:130, :250])


def test_the_part_of_an_unidentified_mechanism_is_not_drawn_in_the_estimate():
    drawables = SceneDrawables(Simulation())
    key = drawables.identified.key("stranger/part")
    assert key not in {part.frame for part in drawables.parts()}
    assert drawables.axis() is None
    assert key not in drawables.poses()


@pytest.mark.long
def test_reports_contain_errors_and_probabilities(chest):
    simulation = chest[0]
    assert f"{1e3 * simulation.average_quality.marker:.0f} mm" in format_kitchen(simulation)
    said = format_mechanism(simulation)
    assert "revolute" in said
    assert f"{simulation.learner.result.best.probability:.2f}" in said
    assert said.count("<polyline") >= 2
    assert "looking" in format_mechanism(Simulation())


@pytest.mark.long
def test_tables_contain_errors_and_the_identified_axis(chest):
    simulation, quality = chest[0], average(chest[1][36:])
    tracked = dict(tabulate_tracking(simulation, quality)[1])
    assert tracked["the track is off by"] == f"{1e3 * quality.mean:.0f} mm"
    assert float(tracked["NEES, 1 is honest"]) == pytest.approx(quality.nees, abs=0.01)
    head, rows = tabulate_identification(simulation)
    assert head[1] == "chest"
    identified = dict(rows)
    assert identified["revolute"].startswith(("0.9", "1.0"))
    assert "conclusion" not in identified
    assert re.fullmatch(r"± [\d.]+°, off by [\d.]+°", identified["axis"])
