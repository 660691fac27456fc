"""Calibration: recovery, uncertainty, what cannot be told, gross errors, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_cases import (
    CAMERA,
    FREE,
    NOISE,
    PALM,
    SimulatedLooks,
    arm_states,
    corrected,
    look_at,
    pr2_with_camera,
    random_pose,
    wrong_arm,
)

import kineverse as kv
from kineverse.estimation import (
    Calibration,
    Look,
    ObservedExpression,
    ObservedPixel,
    ObservedPose,
    ObservedPosition,
    calibrate,
)
from kineverse.estimation.calibration import NoiseGroup, calibration
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array, pose_difference

PR2 = pr2_with_camera()
PALM_MOUNT = f"mount {PALM}"


def errors(result: Calibration, truth: dict[str, float]) -> Array:
    return np.array([value - truth.get(str(symbol), 0.0) for symbol, value in result.state.items()])


def draw(
    seed: int, count: int = 60, noise: tuple[float, float] = NOISE, bad: float = 0.0
) -> tuple[dict[str, float], kv.Model, SimulatedLooks]:
    rng = np.random.default_rng(seed)
    values = wrong_arm(rng)
    truth = corrected(PR2, FREE, values)
    return values, truth, look_at(truth, arm_states(PR2, count, rng), rng, noise=noise, bad=bad)


def test_exact_looks_give_the_exact_model(tmp_path: Path) -> None:
    values, truth, (looks, _) = draw(0, 12, (0.0, 0.0))
    result = calibrate(PR2, looks, FREE)
    assert np.abs(errors(result, values)).max() < 1e-8
    model = PR2.copy()
    version = result.apply(model)
    assert version == model.version == PR2.version + 1
    for state, _ in looks[:3]:
        where = {kv.position(name): value for name, value in state.items()}
        np.testing.assert_allclose(model.fk(PALM, CAMERA)(where), truth.fk(PALM, CAMERA)(where), atol=1e-8)
    model.save(tmp_path / "pr2.kv.json")
    assert kv.load(tmp_path / "pr2.kv.json").snapshot() == model.snapshot()
    with pytest.raises(kv.errors.InvalidValueError, match="has changed since the calibration"):
        result.apply(model)
    with model.edit() as edit:
        edit.undo(version)
    assert model.snapshot() == PR2.snapshot()
    again = calibrate(model, looks, FREE)
    assert np.abs(errors(again, values)).max() < 1e-8


def test_a_model_from_a_document_is_calibrated_too(tmp_path: Path) -> None:
    PR2.save(tmp_path / "pr2.kv.json")
    model = kv.load(tmp_path / "pr2.kv.json")
    values, _, (looks, _) = draw(1, 12, (0.0, 0.0))
    result = calibrate(model, looks, FREE)
    assert np.abs(errors(result, values)).max() < 1e-8
    result.apply(model)
    assert isinstance(model.history.operation("joint pr2/r_elbow_flex_joint"), kv.Revolute)


def whitened_errors(seeds: range, bad: float) -> tuple[float, float, list[dict[str, float]], int]:
    """Return the RMSE in units of the Cramér-Rao bound of the inliers, NEES/dof, sizes of noise, mistakes."""
    ratios, nees, sizes, mistakes = [], [], [], 0
    for seed in seeds:
        values, truth, (looks, mask) = draw(seed, bad=bad)
        result = calibrate(PR2, looks, FREE, held_out=0)
        exact = look_at(truth, [s for s, _ in looks], np.random.default_rng(0), noise=(0.0, 0.0)).looks
        good = [look for look, is_bad in zip(exact, mask, strict=True) if not is_bad]
        bound = calibrate(PR2, good, FREE, noise=NOISE, outliers=None, held_out=0).covariance
        e = errors(result, values)
        ratios.append(np.mean(e**2 / np.diag(bound)))
        nees.append(e @ np.linalg.solve(result.covariance, e) / len(e))
        sizes.append({**result.noise})
        mistakes += len({one.look for one in result.outliers} ^ set(np.flatnonzero(mask).tolist()))
    return float(np.sqrt(np.mean(ratios))), float(np.mean(nees)), sizes, mistakes


def check_statistics(seeds: range, bad: float, most: float, nees: tuple[float, float]) -> None:
    ratio, consistency, sizes, mistakes = whitened_errors(seeds, bad)
    assert ratio <= most
    assert nees[0] <= consistency <= nees[1]
    for name, true in zip(("position", "orientation"), NOISE, strict=True):
        assert np.mean([size[name] for size in sizes]) == pytest.approx(true, rel=0.04)
    assert mistakes == 0


@pytest.mark.parametrize("bad", [0.0, 0.1])
def test_errors_are_near_the_bound_and_of_the_stated_size(bad: float) -> None:
    # 4 draws of 13 errors: standard deviations are 10 % of the RMSE and 20 % of the NEES.
    check_statistics(range(100, 104), bad, 1.25, (0.5, 1.55))


@pytest.mark.long
@pytest.mark.parametrize(("bad", "most"), [(0.0, 1.05), (0.1, 1.10)])
def test_errors_reach_the_bound(bad: float, most: float) -> None:
    check_statistics(range(1000, 1200), bad, most, (0.9, 1.1))


def test_a_head_that_is_held_still_cannot_tell_the_shoulder_from_the_camera() -> None:
    rng = np.random.default_rng(7)
    values = wrong_arm(rng)
    still = {"pr2/head_pan_joint": 0.2, "pr2/head_tilt_joint": 0.4}
    states = [{**state, **still} for state in arm_states(PR2, 40, rng)]
    truth = corrected(PR2, FREE, values)
    result = calibrate(PR2, look_at(truth, states, rng).looks, FREE)
    (direction,) = result.unobservable
    pan = "pr2/r_shoulder_pan_joint/offset"
    assert set(list(direction)[:1]) == {pan}
    assert abs(direction[pan]) == pytest.approx(0.70, abs=0.02)
    assert sum(c**2 for c in direction.values()) == pytest.approx(1.0, abs=1e-3)
    # Turning the shoulder and the camera along the direction changes no prediction.
    moved = corrected(
        PR2, FREE, {str(s): v + 1e-4 * direction.get(str(s), 0.0) for s, v in result.state.items()}
    )
    model = PR2.copy()
    result.apply(model)
    for state in states[:5]:
        where = {kv.position(name): value for name, value in state.items()}
        shift = pose_difference(*(np.asarray(m.fk(PALM, CAMERA)(where)) for m in (moved, model)))
        assert np.abs(shift).max() < 1e-7
    # It stays where it was, and the rest is as good as ever.
    assert (
        abs(sum(c * result.state[name] for name, c in direction.items())) < 1e-4
    )  # coefficients below .01 are left out
    assert result.deviations[pan] == np.inf
    lift = "pr2/r_shoulder_lift_joint/offset"
    assert abs(result.state[lift] - values[lift]) < 5 * result.deviations[lift] < 0.02
    assert f"not told by the data: {pan} 0." in str(result)


def test_the_last_joint_and_an_unknown_marker_are_one_direction_each() -> None:
    _, _, (looks, _) = draw(8, 40)
    result = calibrate(PR2, looks, [*FREE, PALM_MOUNT, "offset pr2/l_elbow_flex_joint"])
    told = [set(direction) for direction in result.unobservable]
    roll = "pr2/r_wrist_roll_joint/offset"
    assert {"pr2/l_elbow_flex_joint/offset"} in told
    (other,) = (one for one in told if roll in one)
    assert "pr2/r_gripper_palm_joint/rx" in other
    assert result.deviations["pr2/l_elbow_flex_joint/offset"] == np.inf
    assert result.state["pr2/l_elbow_flex_joint/offset"] == 0.0
    assert "not told by the data: pr2/l_elbow_flex_joint/offset\n" in str(result)


def test_a_symbol_that_is_not_told_keeps_its_value() -> None:
    """The reach of the tip and the length of a tool behind it are told only together."""
    tool = kv.parameter("tool", 0.7)
    model = MACHINE.copy()
    with model.edit() as edit:
        edit.add_frame("tool", "tip", kv.translation(tool, 0, 0))
    looks = []
    for q in np.linspace(-1, 1, 9).tolist():
        state = {"shoulder": q, "elbow": -q, "spindle": 2 * q}
        where = {kv.position(name): value for name, value in state.items()} | {REACH: 0.45, tool: 0.7}
        looks.append((state, {"tool": model.fk("tool")(where)}))
    result = calibrate(model, looks, [REACH, tool])
    (direction,) = result.unobservable
    assert set(direction) == {"reach", "tool"}
    assert result.state[REACH] + result.state[tool] == pytest.approx(1.15, abs=1e-8)
    # Directions are scaled by the present values: each takes its share by the square of it.
    assert result.state[REACH] - 0.4 == pytest.approx(0.05 * 0.4**2 / (0.4**2 + 0.7**2), abs=1e-8)


def test_noise_is_estimated_or_used_as_it_is() -> None:
    _, _, (looks, _) = draw(9, 40, (0.004, 0.02))
    free = calibrate(PR2, looks, FREE)
    assert free.noise["position"] == pytest.approx(0.004, rel=0.15)
    assert free.noise["orientation"] == pytest.approx(0.02, rel=0.15)
    given = calibrate(PR2, looks, FREE, noise=(0.04, 0.2))
    assert given.noise == {"position": 0.04, "orientation": 0.2}
    np.testing.assert_allclose(np.sqrt(np.diag(given.covariance) / np.diag(free.covariance)), 10, rtol=0.2)
    named = calibrate(PR2, looks, FREE, noise={"orientation": 0.02})
    assert named.noise["orientation"] == 0.02
    assert named.noise["position"] == pytest.approx(0.004, rel=0.15)


def test_the_error_of_looks_left_out_is_that_of_fresh_ones() -> None:
    _, truth, (looks, _) = draw(10, 40)
    result = calibrate(PR2, looks, FREE)
    model = PR2.copy()
    result.apply(model)
    rng = np.random.default_rng(11)
    fresh = look_at(truth, arm_states(PR2, 200, rng), rng).looks
    pose = kv.compile(model.fk(PALM, CAMERA))
    differences = np.array(
        [pose_difference(seen[PALM, CAMERA], pose([s[n] for n in pose.names])) for s, seen in fresh]
    )
    for part, name in ((slice(0, 3), "position"), (slice(3, 6), "orientation")):
        size = np.sqrt(np.square(differences[:, part]).sum(axis=1).mean())
        assert result.held_out[name] == pytest.approx(size, rel=0.2)
        assert result.before[name] > 5 * size
    assert calibrate(PR2, looks, FREE, held_out=0).held_out == {}


# -- other corrections and observations ------------------------------------------------------------------

FOCAL, REACH = kv.parameter("focal", 500.0), kv.parameter("reach", 0.4)
WORDS = ["offset elbow", "length upper", "axis elbow", "pitch spindle", "mount camera"]


def machine() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="shoulder", parent="world", child="lower", axis=(0, 0, 1)))
        edit.apply(
            kv.Fixed(name="upper", parent="lower", child="upper", origin=kv.translation(0.3, 0.1, 0.2))
        )
        edit.apply(kv.Revolute(name="elbow", parent="upper", child="fore", axis=(0, 1, 1)))
        edit.apply(
            kv.articulations.Screw(name="spindle", parent="fore", child="nut", axis=(1, 0, 0), pitch=0.1)
        )
        edit.add_frame("tip", "nut", kv.translation(REACH, 0, 0.1))
        edit.add_frame("camera", "world", kv.translation(0.1, 0.2, -1.5) @ kv.rpy(0.1, -0.1, 0.3))
    return model


MACHINE = machine()


@pytest.mark.parametrize("seen_as", ["poses", "points", "pixels"])
def test_everything_is_recovered_from_each_kind_of_observation(seen_as: str) -> None:
    rng = np.random.default_rng(12)
    values = {
        str(s): rng.normal(0, 0.03) for c in calibration.find_corrections(MACHINE, WORDS) for s in c.symbols
    }
    truth = corrected(MACHINE, WORDS, values)
    points = [(0.1, 0.0, 0.0), (0.0, 0.15, 0.0), (0.0, 0.0, 0.2)]
    looks: list[Look] = []
    for _ in range(15):
        state = {name: float(rng.uniform(-1.2, 1.2)) for name in ("shoulder", "elbow", "spindle")}
        where = {kv.position(name): value for name, value in state.items()} | {REACH: 0.42}
        pose = np.asarray(truth.fk("tip", "camera")(where))
        places = [(pose @ [*point, 1.0])[:3] for point in points]
        seen: Any
        if seen_as == "poses":
            seen = {("tip", "camera"): pose}
        elif seen_as == "points":
            seen = [
                (ObservedPosition("tip", p, relative_to="camera"), x)
                for p, x in zip(points, places, strict=True)
            ]
        else:
            centre = (320.0, 240.0)
            seen = [
                ObservedPixel("tip", "camera", tuple(520 * x[:2] / x[2] + centre), p, (FOCAL, FOCAL), centre)
                for p, x in zip(points, places, strict=True)
            ]
        looks.append(Look(state, seen))
    free = [*WORDS, REACH, *([FOCAL] if seen_as == "pixels" else [])]
    result = calibrate(MACHINE, looks, free)
    assert result.state["reach"] == pytest.approx(0.42, abs=1e-6)
    if seen_as == "pixels":
        assert result.state["focal"] == pytest.approx(520.0, abs=1e-2)
    model = MACHINE.copy()
    result.apply(model)
    # The new value is the parameter's own from now on.
    (reach,) = (s for s in model.symbols if s.role == "parameter")
    assert reach.value == pytest.approx(0.42, abs=1e-6)
    state = {kv.position(name): 0.3 for name in ("shoulder", "elbow", "spindle")}
    wanted = np.asarray(truth.fk("tip", "camera")({**state, REACH: 0.42}))
    np.testing.assert_allclose(model.fk("tip", "camera")({**state, reach: reach.value}), wanted, atol=1e-5)


def test_a_closed_loop_is_calibrated() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="a", parent="world", child="crank", axis=(0, 0, 1)))
        edit.apply(
            kv.Revolute(
                name="b", parent="crank", child="rod", axis=(0, 0, 1), origin=kv.translation(0.3, 0, 0)
            )
        )
        edit.apply(
            kv.Revolute(
                name="c", parent="world", child="rocker", axis=(0, 0, 1), origin=kv.translation(0.8, 0, 0)
            )
        )
        edit.add_frame("rod end", "rod", kv.translation(0.7, 0, 0))
        edit.add_frame("rocker end", "rocker", kv.translation(0, 0.6, 0))
        edit.close_loop("rod end", "rocker end", mask=("x", "y"))
    words, values = ["length rocker end", "offset a"], {"rocker end/length": 0.02, "a/offset": 0.03}
    pose = corrected(model, words, values).fk("rod")
    looks = [({"a": q}, {"rod": pose({kv.position("a"): q})}) for q in np.linspace(0.2, 2.0, 10).tolist()]
    result = calibrate(model, looks, words)
    assert np.abs(errors(result, values)).max() < 1e-8
    result.apply(model)
    np.testing.assert_allclose(
        model.fk("rod")({kv.position("a"): 0.9}), pose({kv.position("a"): 0.9}), atol=1e-8
    )


class Beacon:
    """Recording of its own kind: the squared distance of the tip from the world."""

    def __init__(self, states: list[dict[str, float]], squares: Array) -> None:
        self.states, self.squares = states, squares

    def residual_block(self, model: Any, free: Any, look: int) -> Any:
        place = model.fk("tip")[:3, 3].substitute({REACH: 0.4})
        square = place @ place
        self.parameters = tuple(s for s in free if s in square.symbols)
        coordinates = [s for s in square.symbols if s.role == "dof"]
        slopes = square.partial(list(self.parameters))
        self.function = kv.compile([square, slopes], [*coordinates, *self.parameters])
        self.rows = np.array([[state[str(s)] for s in coordinates] for state in self.states])
        self.looks = look + np.zeros(len(self.rows), dtype=int)
        self.start = None
        return self

    label = "beacon"
    groups = (NoiseGroup("squared distance", "m²", slice(0, 1)),)
    covariance = None

    def evaluate(self, values: Array) -> tuple[Array, Array]:
        inputs = np.column_stack([self.rows, np.tile(values, (len(self.rows), 1))])
        square, slopes = self.function.batch(inputs)
        return (self.squares - square)[:, None], -slopes[:, None, :]

    def log_outlier_density(self, outliers: Outliers) -> float:
        return -float(np.log(outliers.reach))

    def scatter(self) -> Array:
        return (self.squares - self.squares.mean())[:, None]


def test_other_recordings_take_part_by_a_block_of_their_own() -> None:
    rng = np.random.default_rng(13)
    truth = corrected(MACHINE, ["offset elbow", "length upper"], {"elbow/offset": 0.05, "upper/length": 0.02})
    states = [{"elbow": x, "spindle": y, "shoulder": 0.0} for x, y in rng.uniform(-1, 1, (20, 2)).tolist()]
    squares = []
    for state in states:
        where = {kv.position(n): v for n, v in state.items()} | {REACH: 0.4}
        squares.append(float(np.sum(np.asarray(truth.fk("tip")(where))[:3, 3] ** 2)))
    result = calibrate(MACHINE, [Beacon(states, np.array(squares))], ["offset elbow", "length upper"])
    assert result.state["elbow/offset"] == pytest.approx(0.05, abs=1e-6)
    assert result.state["upper/length"] == pytest.approx(0.02, abs=1e-6)
    assert set(result.noise) == {"squared distance"}


def test_the_same_structure_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, (looks, _) = draw(14, 8)
    first = calibrate(PR2, looks, FREE)
    monkeypatch.setattr(calibration, "build_kernel", None)
    second = calibrate(PR2, looks[::-1], FREE)
    for name, value in zip(map(str, first.state), first.state.values(), strict=True):
        assert second.state[name] == pytest.approx(value, abs=1e-4 * first.deviations[name] + 1e-9)


# -- refusals --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [6, 12, 60])
@pytest.mark.parametrize("free", [FREE, ["mount camera", PALM_MOUNT]], ids=["arm", "mounts"])
@pytest.mark.parametrize("noise", [None, NOISE], ids=["unknown", "known"])
def test_gross_errors_alone_are_refused(count: int, free: list[str], noise: Any) -> None:
    rng = np.random.default_rng(15)
    states = arm_states(PR2, count, rng)
    looks = [(state, {(PALM, CAMERA): random_pose(rng)}) for state in states]
    with pytest.raises(kv.KineverseError, match=r"do not fit the model|contradict each other"):
        calibrate(PR2, looks, free, noise=noise)


def test_shuffled_looks_are_refused() -> None:
    _, _, (looks, _) = draw(16)
    shifted = [(state, seen) for (state, _), (_, seen) in zip(looks, looks[7:] + looks[:7], strict=True)]
    with pytest.raises(kv.KineverseError, match=r"do not fit the model|contradict each other"):
        calibrate(PR2, shifted, FREE)


@pytest.mark.parametrize("bad", [0.1, 0.3, 0.45])
def test_any_minority_of_gross_errors_is_found(bad: float) -> None:
    values, _, (looks, mask) = draw(17, bad=bad)
    result = calibrate(PR2, looks, FREE)
    assert {one.look for one in result.outliers} == set(np.flatnonzero(mask).tolist())
    assert np.abs(errors(result, values) / np.sqrt(np.diag(result.covariance))).max() < 5


@pytest.mark.parametrize("free", [FREE, ["mount camera", PALM_MOUNT]], ids=["arm", "mounts"])
@pytest.mark.parametrize(("bad", "good"), [(0.55, 27), (0.6, 24)])
def test_the_good_looks_are_counted_where_they_are_a_minority(free: list[str], bad: float, good: int) -> None:
    """Noise of .2 m and 50 deg would pass for what fits most looks."""
    _, _, (looks, _) = draw(0, bad=bad)
    with pytest.raises(kv.KineverseError, match=f"only {good} of 60 observations agree"):
        calibrate(PR2, looks, free)


def test_a_few_good_looks_are_refused() -> None:
    _, _, (looks, _) = draw(17, bad=0.8)
    with pytest.raises(kv.KineverseError, match=r"do not fit the model|contradict each other"):
        calibrate(PR2, looks, FREE)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_looks_are_refused_with_numbers(count: int) -> None:
    _, _, (looks, _) = draw(18, count)
    has = "1 look has 6" if count == 1 else "2 looks have 12"
    with pytest.raises(
        kv.errors.InvalidValueError, match=f"13 free .* at least 14 observed numbers, and {has}"
    ):
        calibrate(PR2, looks, FREE)


def test_a_mount_alone_is_calibrated_from_looks_at_rest() -> None:
    rng = np.random.default_rng(19)
    (state,) = arm_states(PR2, 1, rng)
    looks = look_at(corrected(PR2, FREE, {"camera/dx": 0.05}), [state] * 8, rng).looks
    result = calibrate(PR2, looks, ["mount camera"])
    assert result.state["camera/dx"] == pytest.approx(0.05, abs=6 * result.deviations["camera/dx"])


LOOKS = draw(20, 8)[2].looks
BAD: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"free": []}, kv.errors.InvalidValueError, "Nothing is free"),
    ({"free": [3]}, kv.errors.InvalidValueError, "texts such as"),
    ({"free": [kv.position("pr2/torso_lift_joint")]}, kv.errors.InvalidValueError, "symbols of kv.parameter"),
    ({"free": ["offset pr2/l_elbow_flex_joint"]}, kv.errors.InvalidValueError, "No observation depends on"),
    (
        {"free": [*FREE, kv.parameter("p", 1.0)]},
        kv.errors.UnknownNameError,
        "'p' with the value 1 is neither",
    ),
    ({"recordings": []}, kv.errors.InvalidValueError, "There are no looks"),
    ({"recordings": 3}, kv.errors.InvalidValueError, "a list of looks"),
    ({"model": PR2.snapshot()}, kv.errors.InvalidValueError, "A model is calibrated"),
    ({"noise": 0.1}, kv.errors.InvalidValueError, "a pair of standard deviations"),
    ({"noise": (0, 1)}, kv.errors.InvalidValueError, "noise of 'position' is a positive"),
    ({"noise": {"pos": 1}}, kv.errors.UnknownNameError, "Available: orientation, position"),
    ({"held_out": 1}, kv.errors.InvalidValueError, "held_out is 0, or at least 2"),
    ({"outliers": 0.1}, kv.errors.InvalidValueError, "Outliers are True"),
    ({"outliers": Outliers(gate=3.0)}, kv.errors.InvalidValueError, "Only a tracker has a gate"),
]


@pytest.mark.parametrize(("given", "kind", "words"), BAD, ids=[words for *_, words in BAD])
def test_wrong_arguments_say_what_is_right(given: dict[str, Any], kind: type[Exception], words: str) -> None:
    arguments = {"model": PR2, "recordings": LOOKS, "free": FREE, **given}
    with pytest.raises(kind, match=words):
        calibrate(arguments.pop("model"), arguments.pop("recordings"), arguments.pop("free"), **arguments)


def test_points_behind_the_image_plane_are_refused() -> None:
    pixel = ObservedPixel("camera", "camera", (1.0, 2.0), focal=(500, 500))
    with pytest.raises(kv.errors.InvalidValueError, match="no finite prediction in look 0"):
        calibrate(PR2, [(state, [pixel, (ObservedPose(PALM, relative_to=CAMERA), seen[PALM, CAMERA])])
                        for state, seen in LOOKS], FREE)  # fmt: skip


def test_stated_covariances_weigh_each_observation() -> None:
    values, _, (looks, _) = draw(21, 30)
    exact = [
        (state, {ObservedPose(PALM, relative_to=CAMERA, covariance=NOISE): pose for pose in seen.values()})
        for state, seen in looks
    ]
    result = calibrate(PR2, exact, FREE)
    known = calibrate(PR2, looks, FREE, noise=NOISE)
    np.testing.assert_allclose([*result.state.values()], [*known.state.values()], atol=1e-6)
    np.testing.assert_allclose(result.covariance, known.covariance, rtol=1e-4, atol=1e-12)
    assert result.noise == {}
    assert abs(errors(result, values)).max() < 0.01


def test_an_observed_expression_tells_its_parameters() -> None:
    height = ObservedExpression("height", MACHINE.fk("tip")[2, 3], 1e-6)
    looks = []
    for q in np.linspace(-1, 1, 9).tolist():
        state = {"shoulder": q, "elbow": q, "spindle": q}
        where = {kv.position(name): value for name, value in state.items()}
        looks.append((state, {height: MACHINE.fk("tip")({**where, REACH: 0.45})[2, 3]}))
    result = calibrate(MACHINE, looks, [REACH])
    assert result.state[REACH] == pytest.approx(0.45, abs=1e-8)
    with pytest.raises(kv.errors.InvalidValueError, match="'height' does not depend on what is free"):
        calibrate(MACHINE, looks, ["offset elbow"])


def test_the_result_is_readable() -> None:
    _, _, (looks, _) = draw(22, bad=0.1)
    text = str(calibrate(PR2, looks, FREE))
    assert text.startswith("Calibration of 13 parameters from 60 looks\n")
    assert "pr2/r_elbow_flex_joint/offset " in text
    assert " mm\n" in text
    assert " deg\n" in text
    assert "a look not used is off by" in text
    assert "\n6 gross errors, in looks " in text
    assert "6 gross errors, in looks " in text
