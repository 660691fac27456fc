"""The scene that lives, without a browser: what moves, what is seen, what is believed and learned."""

from __future__ import annotations

import math

import numpy as np
import pytest
from living_kitchen.axis_uncertainty import error, spread
from living_kitchen.gating import Sorter
from living_kitchen.marker_meshes import REACH, SIGMAS, axis_line, axis_tube, rod
from living_kitchen.panel import kitchen_report, stranger_report
from living_kitchen.picture import picture
from living_kitchen.placed_model import doubtful
from living_kitchen.scene import Scenery
from living_kitchen.sensor import Markers, Sight
from living_kitchen.simulation import Life
from living_kitchen.track import average
from living_kitchen.trajectory import Routine
from living_kitchen.unknown_mechanisms import STRANGERS
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.estimation import identify, pose_covariance

STEP = 1.0 / 12.0


def lived(seconds, **options):
    """Return a life after some seconds, and at each step its figures and how far off the stranger's part is."""
    life, figures, off = Life(**options), [], []
    for _ in range(round(seconds / STEP)):
        life.step(STEP)
        figures.append(life.now)
        off.append(life.part_error)
    return life, figures, off


@pytest.fixture(scope="module")
def chest():
    return lived(10.0)


# -- what moves --------------------------------------------------------------------------------------------


def test_everything_opens_within_its_limits_and_no_faster_than_it_may():
    model = kv.load("kitchen")
    routine = Routine(model)
    names, h = routine.names, 1e-4
    assert sorted(names) == sorted(map(str, model.degrees_of_freedom))
    reached = dict.fromkeys(names, 0.0)
    for time in np.arange(0.0, routine.period + 8.0, 0.15):
        now, soon = routine.at(time), routine.at(time + h)
        speeds = {f"{name}:velocity": (soon[name] - now[name]) / h for name in names}
        assert not list(model.violations({**now, **speeds}))
        for name in names:
            low, high = model.limits(name)
            reached[name] = max(reached[name], (now[name] - low) / (high - low))
    assert min(reached.values()) > 0.85


def test_a_few_things_move_at_a_time_and_all_of_it_repeats():
    routine = Routine(kv.load("kitchen"))
    for time in np.linspace(5.0, routine.period, 30):
        later, soon = routine.at(time + routine.period), routine.at(time + 0.1)
        now = routine.at(time)
        assert 1 <= sum(abs(now[n] - soon[n]) > 1e-4 for n in now) <= 12
        for name in routine.names[:3]:
            assert later[name] == pytest.approx(now[name], abs=1e-9)


# -- what is seen ------------------------------------------------------------------------------------------


def test_noise_is_what_its_covariance_says_and_the_shares_are_what_was_asked_for():
    poses = np.tile(np.eye(4), (4000, 1, 1))
    poses[:, :3, :3] = Rotation.random(4000, random_state=1).as_matrix()
    sight = Sight(0.02, outliers=0.2, hidden=0.5)
    seen = Markers(4000, 0).look(poses, 0.0, sight)
    good = ~seen.wrong
    turns = Rotation.from_matrix(seen.poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)).as_rotvec()
    errors = np.hstack([seen.poses[:, :3, 3], turns])[good]
    # Of 3200 numbers the standard deviation is known to 1.3 %.
    np.testing.assert_allclose(errors.std(axis=0), np.sqrt(np.diag(sight.covariance)), rtol=0.06)
    assert seen.wrong.mean() == pytest.approx(0.2, abs=0.03)
    assert seen.there.mean() == pytest.approx(0.5, abs=0.04)
    assert np.linalg.norm(seen.poses[seen.wrong, :3, 3], axis=1).mean() > 0.3


@pytest.mark.parametrize("wrong", [{"noise": 0.0}, {"noise": math.nan}, {"outliers": 1.0}, {"hidden": -0.1}])
def test_a_sight_that_is_none_is_refused(wrong):
    with pytest.raises(kv.errors.InvalidValueError, match=next(iter(wrong))):
        Sight(**wrong)


def test_equal_seeds_live_equal_lives_and_others_do_not():
    # C that becomes ready in the midst of a life rounds otherwise than numpy.
    Life().following.tracker.wait()
    one, two, other = (lived(0.5, seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.seen.poses, two.seen.poses)
    assert one.following.values == two.following.values
    assert one.following.values != other.following.values


# -- what is believed --------------------------------------------------------------------------------------


def test_the_track_is_nearer_than_the_markers_and_as_sure_as_it_may_be(chest):
    figures = average(chest[1][36:])
    assert figures.marker == pytest.approx(math.sqrt(3.0) * 0.03, rel=0.05)
    assert figures.mean < 0.25 * figures.marker
    assert 0.75 < figures.nees < 1.3


def test_outliers_are_told_apart():
    life, figures, _ = lived(2.5, sight=Sight(0.03, outliers=0.2))
    assert average(figures[12:]).mean < 0.3 * math.sqrt(3.0) * 0.03
    wrong = {
        f for f, w, t in zip(life.following.frames, life.seen.wrong, life.seen.there, strict=True) if w & t
    }
    assert wrong
    assert len(wrong.symmetric_difference(life.following.estimate.outliers)) <= 2


def test_who_does_not_see_a_door_knows_how_far_it_may_have_gone():
    _, figures, _ = lived(20.0, seed=1, sight=Sight(0.03, hidden=0.5))
    assert 0.6 < average(figures[36:]).nees < 1.5


def test_what_is_hidden_becomes_doubtful_and_another_noise_is_taken_in():
    life, *_ = lived(1.5)
    sure = life.following.doubt()
    life.sight = Sight(0.05, hidden=0.5)
    for _ in range(24):
        life.step(STEP)
    doubt = life.following.doubt()
    assert 5 <= (~life.seen.there).sum() <= 18
    assert doubt[~life.seen.there].mean() > 3.0 * sure.mean()
    assert doubt[~life.seen.there].mean() > 2.0 * doubt[life.seen.there].mean()
    assert doubtful(0.8) != doubtful(0.05)


def test_ways_lead_through_the_tracked_places_and_are_as_long_as_doubts(chest):
    following = chest[0].following
    ways = following.ways()
    np.testing.assert_allclose(ways[:, 2], following.places(following.values), atol=1e-12)
    lengths = np.linalg.norm(np.diff(following.ways(3), axis=1), axis=2).sum(axis=1)
    np.testing.assert_allclose(following.doubt(), lengths)


# -- what is learned ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(STRANGERS))
def test_a_stranger_is_learned_and_then_tracked(name, chest):
    life, _, off = chest if name == "chest" else lived(10.0, stranger=name)
    stranger, learner = life.stranger, life.learner
    assert max(learner.thoughts[0].probabilities.values()) < 0.95  # nobody can tell at first
    assert not learner.found.is_ambiguous
    assert learner.found.best.family == stranger.family
    angle, distance, sigmas = error(learner.found.best, *stranger.axis)
    assert angle < math.radians(9.0)
    assert distance < 0.06
    assert sigmas < 2.2
    # The mean of what a marker is off is 1.6 standard deviations of one coordinate.
    assert np.mean(off[-20:]) < 1.2 * life.sight.noise


def test_a_stranger_is_learned_between_outliers():
    life, *_ = lived(8.0, seed=2, sight=Sight(0.03, outliers=0.2))
    best = life.learner.found.best
    assert (best.family, life.learner.found.is_ambiguous) == ("revolute", False)
    assert error(best, *life.stranger.axis)[0] < math.radians(9.0)


def test_wrong_poses_of_a_stranger_are_sorted_out():
    sorter, markers, sight = Sorter(), Markers(2, 3), Sight(0.03, outliers=0.2, hidden=0.3)
    missed = dropped = right = 0
    for k in range(120):
        poses = np.stack(STRANGERS["stool"]().poses(0.5 - 0.5 * math.cos(0.1 * k)))
        seen = markers.look(poses, k * STEP, sight)
        good = sorter.good(seen, STEP, sight)
        assert not (good & ~seen.there).any()
        missed += (seen.wrong & good).sum()
        right += (seen.there & ~seen.wrong).sum()
        dropped += (seen.there & ~seen.wrong & ~good).sum()
    assert missed <= 1
    assert dropped < 0.05 * right


def test_another_stranger_is_met_from_the_beginning():
    life, *_ = lived(2.0)
    assert life.learner.found is not None
    life.meet()
    assert (life.stranger.name, life.learner.found, life.part_error) == ("crate", None, None)
    life.step(STEP)
    assert len(life.learner.seen) == 1
    with pytest.raises(kv.errors.UnknownNameError, match=r"'boat'.*chest"):
        life.meet("boat")
    assert life.stranger.name == "crate"


def test_a_stranger_stays_for_a_while_and_goes():
    life = Life()
    life.step(39.0)
    assert life.stranger.name == "chest"
    life.step(2.0)
    assert life.stranger.name == "crate"


@pytest.mark.parametrize("name", list(STRANGERS))
def test_where_the_true_axis_is_what_a_fit_of_exact_poses_finds(name):
    stranger = STRANGERS[name]()
    poses = [stranger.poses(q) for q in np.linspace(*stranger.reach, 30)]
    base, part = (np.array(found) for found in zip(*poses, strict=True))
    fit = identify(base, part, noise=pose_covariance(1e-4, 1e-4))[stranger.family]
    angle, distance, _ = error(fit, *stranger.axis)
    assert angle < 1e-6
    assert distance < 1e-6


def test_the_spread_of_an_axis_is_that_of_axes_drawn_by_its_covariance(chest):
    fit = chest[0].learner.found.best
    index = [fit.coordinates.index(n) for n in ("point.x", "point.y", "axis.x", "axis.y")]
    covariance = fit.covariance[np.ix_(index, index)]
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(4), covariance, 20_000)
    height = 0.6
    ways = Rotation.from_rotvec(np.pad(drawn[:, 2:], ((0, 0), (0, 1)))).as_matrix()[:, :, 2]
    crossings = drawn[:, :2] + height * ways[:, :2] / ways[:, 2:]
    expected = np.cov(crossings.T)
    found = spread(fit, np.array([height]))[0]
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


# -- what is drawn -----------------------------------------------------------------------------------------


def test_rods_are_round_and_tubes_two_deviations_wide(chest):
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.2], [0.2, 0.4, 0.4]])
    away = rod(points, 0.05).vertices - np.repeat(points, 16, axis=0)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.05)
    np.testing.assert_allclose(away @ [1.0, 2.0, 2.0], 0.0, atol=1e-12)
    fit, near = chest[0].learner.found.best, np.array([0.0, 0.1, 0.4])
    ends = axis_line(fit, near)
    middle = ends.mean(axis=0)
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(2.0 * REACH)
    assert (near - middle) @ (ends[1] - ends[0]) == pytest.approx(0.0, abs=1e-12)
    ring = (axis_tube(fit, near).vertices.reshape(13, -1, 3)[6] - middle) @ fit.frame[:3, :2]
    above = float((middle - fit.frame[:3, 3]) @ fit.frame[:3, 2])
    squares = np.einsum("ni,ij,nj->n", ring, np.linalg.inv(spread(fit, np.array([above]))[0]), ring)
    np.testing.assert_allclose(np.sqrt(squares), SIGMAS, rtol=0.02)


def test_a_picture_shows_both_worlds_and_the_axis_once_it_is_known(chest):
    young, life = Life(), chest[0]
    before, after = (picture(one, (500, 260)).astype(int) for one in (young, life))
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


def test_the_part_that_nobody_understands_yet_is_not_drawn_as_if_one_did():
    scenery = Scenery(Life())
    key = scenery.learned.key("stranger/part")
    assert key not in {part.frame for part in scenery.parts()}
    assert scenery.axis() is None
    assert key not in scenery.poses()


def test_reports_say_what_the_numbers_are(chest):
    life = chest[0]
    assert f"{1e3 * life.figures.marker:.0f} mm" in kitchen_report(life)
    said = stranger_report(life)
    assert "revolute" in said
    assert f"{life.learner.found.best.probability:.2f}" in said
    assert said.count("<polyline") >= 2
    assert "looking" in stranger_report(Life())
