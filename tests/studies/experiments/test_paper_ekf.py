"""The papers' filter: its equations, implemented a second time, and its refusals."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.errors import InvalidValueError, ModelError, ShapeError, UnknownNameError
from kineverse_studies.experiments.fig4.paper_ekf import PaperEkf

HINGE = ("door", "handle")


@pytest.fixture(scope="module")
def furniture():
    """Return a door with a handle, a drawer within a drawer, a knob without limits, and a wall."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=1.5))
        edit.add_frame("handle", parent="door", transform=kv.translation(0.1, 0.6, 0))
        edit.apply(
            kv.Prismatic(name="drawer", parent="world", child="drawer", axis=(1, 0, 0), lower=0, upper=0.4)
        )
        edit.apply(
            kv.Prismatic(name="inner", parent="drawer", child="inner", axis=(1, 0, 0), lower=0, upper=0.2)
        )
        edit.apply(kv.Continuous(name="knob", parent="world", child="knob", axis=(1, 0, 0)))
        edit.add_frame("wall", parent="world", transform=kv.translation(1, 0, 0))
    return model


def poses(model, frames, **values):
    """Return the poses of frames at values of coordinates, (m, 4, 4)."""
    found = []
    for frame in frames:
        pose = model.fk(frame)
        found.append(pose({s: values[str(s)] for s in pose.symbols}))
    return np.stack(found)


def seen(true, rng, count=None, position=0.02, orientation=0.05):
    """Return poses with errors on each of their own axes, one observation or several."""
    lead = true.shape[:-2] if count is None else (count, *true.shape[:-2])
    found = np.broadcast_to(true, (*lead, 4, 4)).copy()
    found[..., :3, 3] += rng.normal(0, position, (*lead, 3))
    turns = Rotation.from_rotvec(rng.normal(0, orientation, (*lead, 3)).reshape(-1, 3)).as_matrix()
    found[..., :3, :3] = found[..., :3, :3] @ turns.reshape(*lead, 3, 3)
    return found


def door_entries(q):
    """Return the entries of door and handle that depend on the door's angle, row by row."""
    c, s = math.cos(q), math.sin(q)
    return np.array([c, -s, s, c, c, -s, 0.1 * c - 0.6 * s, s, c, 0.1 * s + 0.6 * c])


def entries_of(two):
    """Return the same entries of observed poses."""
    door, handle = two
    return np.array([*door[0, :2], *door[1, :2], *handle[0, [0, 1, 3]], *handle[1, [0, 1, 3]]])


def door_slopes(q):
    """Return their exact derivatives: the noise is too ill-conditioned for difference quotients."""
    c, s = math.cos(q), math.sin(q)
    return np.array([-s, -c, c, -s, -s, -c, -0.1 * s - 0.6 * c, c, -s, 0.1 * c - 0.6 * s])


def test_hinge_follows_the_published_equations(furniture):
    rng, published = np.random.default_rng(1), PaperEkf(furniture, HINGE)
    training = seen(poses(furniture, HINGE, door=0.3), rng, 400)
    published.learn_noise(training)
    R = np.cov(np.array([entries_of(t) for t in training]), rowvar=False)
    q, variance = 0.75, 0.75**2
    true = poses(furniture, HINGE, door=1.2)

    first = seen(true, rng)
    for _ in range(10):
        q += 0.1 * door_slopes(q) @ (entries_of(first) - door_entries(q))
    assert published.update(first) == pytest.approx([q], abs=1e-8)
    assert published.covariance == pytest.approx(np.array([[variance]]))

    lost = 0.0
    for _ in range(20):
        z, H = seen(true, rng), door_slopes(q)[:, None]
        S = variance * H @ H.T + R
        # By information, which rounds hardly at all; as published, 1 - K H cancels what the inverse of S got wrong.
        remaining = 1 / (1 + variance * float((H.T @ np.linalg.solve(R, H))[0, 0]))
        lost = max(lost, np.finfo(float).eps * np.linalg.cond(S) / remaining)
        variance *= remaining
        K = variance * np.linalg.solve(R, H)[:, 0]
        q += float(K @ (entries_of(z) - door_entries(q)))
        assert published.update(z) == pytest.approx([q], abs=1e-7)
        assert published.covariance == pytest.approx(np.array([[variance]]), rel=lost)
    assert lost < 1e-4
    assert q == pytest.approx(1.2, abs=0.05)


def test_nested_drawers_equal_weighted_least_squares(furniture):
    rng = np.random.default_rng(2)
    frames = ("inner", "drawer")
    published = PaperEkf(furniture, frames, steps=0)
    assert [str(s) for s in published.symbols] == ["drawer", "inner"]
    assert len(published.groups) == 1
    training = seen(poses(furniture, frames, drawer=0.1, inner=0.1), rng, 50)
    published.learn_noise(training)
    observed = seen(poses(furniture, frames, drawer=0.3, inner=0.05), rng, 8)
    for z in observed:
        published.update(z)
    # What a linear filter ends with is weighted least squares on prior and all but the first observation.
    H = np.array([[1.0, 1.0], [1.0, 0.0]])
    weight = np.linalg.inv(np.cov(training[:, :, 0, 3], rowvar=False))
    prior = np.diag([1 / 0.2**2, 1 / 0.1**2])
    information = prior + 7 * H.T @ weight @ H
    mean = np.linalg.solve(information, prior @ [0.2, 0.1] + H.T @ weight @ observed[1:, :, 0, 3].sum(axis=0))
    assert published.q == pytest.approx(mean)
    assert published.covariance == pytest.approx(np.linalg.inv(information))


def test_constant_entries_are_ignored(furniture):
    """Errors in constant entries make no difference."""
    rng = np.random.default_rng(3)
    frames = ("drawer", "door")
    one, other = (PaperEkf(furniture, frames) for _ in range(2))
    training = seen(poses(furniture, frames, drawer=0.1, door=0.2), rng, 50)
    for f in (one, other):
        f.learn_noise(training)
    for z in seen(poses(furniture, frames, drawer=0.2, door=0.4), rng, 5):
        wrong = z.copy()
        wrong[0, :3, :3], wrong[0, 1:3, 3] = 7.0, 8.0
        wrong[1, :3, 3], wrong[1, 2, :], wrong[1, :3, 2] = 9.0, 9.0, 9.0
        np.testing.assert_array_equal(one.update(z), other.update(wrong))


@pytest.mark.parametrize(
    "order", [("door", "inner", "knob", "drawer", "handle"), ("inner", "handle", "drawer")]
)
def test_frames_that_share_coordinates_form_a_group_in_any_order(furniture, order):
    groups = {tuple(map(str, group)) for group in PaperEkf(furniture, order).groups}
    assert groups == {("door",), ("drawer", "inner")} | ({("knob",)} if "knob" in order else set())


def test_groups_are_independent(furniture):
    rng = np.random.default_rng(4)
    frames = ("door", "drawer", "handle", "knob")
    both, alone = PaperEkf(furniture, frames), PaperEkf(furniture, HINGE)
    true = poses(furniture, frames, door=0.5, drawer=0.3, knob=2.0)
    training = seen(true, rng, 100)
    both.learn_noise(training)
    alone.learn_noise(training[:, [0, 2]])
    for z in seen(true, rng, 6):
        both.update(z)
        alone.update(z[[0, 2]])
    assert both.q[both.symbols.index(kv.position("door"))] == pytest.approx(alone.q[0], rel=1e-12)
    assert np.count_nonzero(both.covariance) == 3


def test_copies_equal_separate_filters(furniture):
    rng = np.random.default_rng(5)
    frames = ("door", "inner", "drawer")
    side_by_side = PaperEkf(furniture, frames, copies=3)
    alone = [PaperEkf(furniture, frames) for _ in range(3)]
    true = poses(furniture, frames, door=1.0, drawer=0.1, inner=0.15)
    training = seen(true, rng, 60)
    for f in (side_by_side, *alone):
        f.learn_noise(training)
    for z in seen(np.broadcast_to(true, (3, *true.shape)), rng, 5):
        np.testing.assert_allclose(
            side_by_side.update(z), [f.update(own) for f, own in zip(alone, z, strict=True)], rtol=1e-9
        )
    np.testing.assert_allclose(side_by_side.covariance, [f.covariance for f in alone], rtol=1e-9)


def test_start_is_the_middle_of_the_limits(furniture):
    published = PaperEkf(furniture, ("door", "knob"))
    np.testing.assert_allclose(published.limits, [[0, 1.5], [-math.pi, math.pi]])
    np.testing.assert_allclose(published.q, [0.75, 0])
    np.testing.assert_allclose(published.covariance, np.diag([0.75**2, math.pi**2]))


def test_reset_keeps_only_the_noise(furniture):
    rng, published = np.random.default_rng(6), PaperEkf(furniture, HINGE)
    true = poses(furniture, HINGE, door=1.0)
    published.learn_noise(seen(true, rng, 50))
    observed = seen(true, rng, 4)
    first = [published.update(z) for z in observed]
    published.reset()
    np.testing.assert_array_equal([published.update(z) for z in observed], first)


def test_commanded_speeds_move_the_prediction(furniture):
    published = PaperEkf(furniture, ("door", "drawer"))
    before = published.q.copy()
    published.predict(0.05)
    np.testing.assert_array_equal(published.q, before)
    published.predict(0.05, {kv.velocity("drawer"): 0.2, "door:velocity": -1.0})
    moved = dict(zip(map(str, published.symbols), published.q - before, strict=True))
    assert moved == pytest.approx({"door": -0.05, "drawer": 0.01})
    with pytest.raises(UnknownNameError, match=r"'dor:velocity' is no velocity here.*door:velocity"):
        published.predict(0.05, {"dor:velocity": 1.0})


def test_parameters_keep_their_values():
    model = kv.Model()
    with model.edit() as edit:
        length, turn = kv.parameter("length", 0.5), kv.rotation_z(kv.position("lid"))
        edit.add_frame("lid", parent="world", transform=turn @ kv.translation(length, 0, 0))
    published = PaperEkf(model, ["lid"])
    assert published.symbols == (kv.position("lid"),)
    at = model.fk("lid")({"lid": 0.4, "length": 0.5})
    for _ in range(30):
        published.reset()
        published.update(at[None])
    assert 0 < published.q[0] <= 0.4


def test_invalid_observations_are_refused_without_effect(furniture):
    rng, published = np.random.default_rng(7), PaperEkf(furniture, HINGE)
    true = poses(furniture, HINGE, door=1.0)
    published.update(true)
    with pytest.raises(InvalidValueError, match="noise of what shows door is not known"):
        published.update(true)
    published.learn_noise(seen(true, rng, 50))
    q, covariance = published.update(true), published.covariance
    broken = true.copy()
    broken[1, 0, 3] = math.nan
    with pytest.raises(InvalidValueError, match="NaN"):
        published.update(broken)
    with pytest.raises(ShapeError, match=r"\(1, 4, 4\), expected is \(2, 4, 4\)"):
        published.update(true[:1])
    np.testing.assert_array_equal(published.q, q)
    np.testing.assert_array_equal(published.covariance, covariance)


def test_singular_innovation_covariance_is_refused(furniture):
    published, true = PaperEkf(furniture, HINGE), poses(furniture, HINGE, door=1.0)
    published.learn_noise([true, true])
    published.update(true)
    with pytest.raises(InvalidValueError, match="expected for door is singular"):
        published.update(true)
    with pytest.raises(InvalidValueError, match="One observation has no covariance"):
        published.learn_noise([true])


def test_step_beyond_the_model_is_refused():
    """The published garage door has no angle beyond a = 2."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.GarageDoor(name="garage", parent="world", length=2.0, form="published"))
    published = PaperEkf(model, ["garage/door"])
    high = model.fk("garage/door")({"garage/door": 2.0})
    high[2, 3] -= 1.5
    with pytest.raises(InvalidValueError, match=r"garage/door = \[1\.\] leads nowhere"):
        published.update(high[None])
    assert published.q == pytest.approx([1.0])


def test_frames_without_coordinates_are_refused(furniture):
    with pytest.raises(ModelError, match="'wall' depends on no coordinate"):
        PaperEkf(furniture, ["door", "wall"])
    with pytest.raises(UnknownNameError, match="handle"):
        PaperEkf(furniture, ["handel"])
    with pytest.raises(InvalidValueError, match="No frame"):
        PaperEkf(furniture, [])
