"""Stages in C are those in numpy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from part_recordings import JOINTS, recording

from kineverse.errors import ShapeError
from kineverse.estimation import identify
from kineverse.estimation.identification import native, refining
from kineverse.estimation.identification.evidence import evidence, overrated
from kineverse.estimation.identification.groups import GROUPS, Freedom, GroupMotion
from kineverse.estimation.identification.library import library
from kineverse.estimation.identification.native import solver
from kineverse.estimation.identification.observations import Observations, observations
from kineverse.estimation.identification.refining import Rated
from kineverse.estimation.identification.solving import Belief, Start, solve, solve_first
from kineverse.estimation.identification.starts import Overview, starts

HOW = ("both noisy", "parent known", "positions", "each with its own noise")
MOVING = [family for family in JOINTS if family not in ("rigid", "free")]


def seen_as(how: str, family: str) -> Observations:
    seen = recording(family, count=12, position=0.02, orientation=0.05, seed=1)
    c = seen.covariance
    if how == "both noisy":
        return observations(seen.parent, seen.child, c, c)
    if how == "parent known":
        return observations(seen.true_parent, seen.child, None, c)
    if how == "positions":
        return observations(seen.parent, seen.child[:, :3, 3], c, c)
    factors = np.linspace(0.8, 1.3, 12)[:, None, None]
    return observations(seen.parent, seen.child, factors * c, c / factors)


def precise(family: str, whole: bool) -> Observations:
    """Return positions so precise that steps have to be led to them."""
    seen = recording(family, count=12, position=0.001, orientation=0.1, seed=1)
    child = seen.child if whole else seen.child[:, :3, 3]
    result = observations(seen.parent, child, seen.covariance, seen.covariance)
    assert len(result.softened()) > 1
    return result


def same(slow: Rated, fast: Rated, atol: float = 1e-4, log: float = 0.05) -> None:
    one, other = slow.solution, fast.solution
    # Steps end where they promise little, which is not the same place to the last digit.
    assert fast.log_evidence == pytest.approx(slow.log_evidence, abs=log)
    assert other.cost == pytest.approx(one.cost, abs=log)
    assert other.belief.marginal == one.belief.marginal
    np.testing.assert_allclose(other.belief.precision, one.belief.precision, rtol=0.05)
    seen = slice(None) if one.motion.rows == 6 else 3  # of the pose of what was seen as a position
    np.testing.assert_allclose(other.linear.pose[:, :3, seen], one.linear.pose[:, :3, seen], atol=atol)
    np.testing.assert_allclose(other.residuals, one.residuals, atol=atol)
    # All of it belongs together.
    for a, b in zip(other.linear, other.motion.at(other.values), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.fixture(autouse=True)
def compiled() -> None:
    assert solver.prepare(wait=True)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_c_and_numpy_agree(family: str, how: str) -> None:
    seen = seen_as(how, family)
    start = next(starts(family, Overview(seen)))
    slow = solve(seen, *start)
    fast = solver.solve(seen, start, seen.parent, slow.belief)
    assert fast.cost == pytest.approx(slow.cost, rel=1e-6, abs=1e-6)
    if slow.converged and fast.converged:
        for a, b in zip(slow.motion.at(slow.values), fast.motion.at(fast.values), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        np.testing.assert_allclose(slow.residuals, fast.residuals, atol=1e-4)


@pytest.mark.compiler
@pytest.mark.parametrize("family", MOVING)
@pytest.mark.parametrize("how", HOW)
def test_steps_with_joint_values_integrated_out_agree(family: str, how: str) -> None:
    seen = seen_as(how, family)
    start = next(starts(family, Overview(seen)))
    near = solve(seen, start.motion, start.values)
    # C has derivatives in closed form, and numpy takes differences.
    belief = Belief(near.values.mean(axis=0), np.full(near.motion.joints, 0.3**-2), marginal=True)
    slow = solve(seen, near.motion, near.values, near.parent, belief, steps=1)
    fast = solver.solve(seen, Start(near.motion, near.values), near.parent, belief, steps=1)
    assert fast.cost == pytest.approx(slow.cost, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(fast.linear.pose, slow.linear.pose, atol=1e-6)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_poses_agree(family: str, how: str) -> None:
    start = next(starts(family, Overview(seen_as(how, family))))
    assert isinstance(start.motion, GroupMotion)
    for slow, fast in zip(
        start.motion.at(start.values, native=False), start.motion.at(start.values), strict=True
    ):
        np.testing.assert_allclose(slow, fast, atol=1e-13)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_the_likeliest_member_is_the_same(family: str, how: str) -> None:
    seen = seen_as(how, family)
    begin = [*starts(family, Overview(seen))]
    same(refining.likeliest(seen, begin), solver.likeliest(seen, begin))


@pytest.mark.compiler
@pytest.mark.parametrize("family", MOVING)
@pytest.mark.parametrize("how", ["both noisy", "parent known"])
def test_integrating_joint_values_out_is_the_same(family: str, how: str) -> None:
    seen = seen_as(how, family)
    near = solve_first(seen, [*starts(family, Overview(seen))])
    slow, fast = refining.refined(seen, near), solver.refined(seen, near)
    assert slow.solution.belief.marginal
    same(slow, fast, atol=0.02)
    # One more observation, and the first ones are where they were.
    part = seen.at(slice(0, 10))
    before = refining.refined(part, solve_first(part, [*starts(family, Overview(part))])).solution
    start = Start(before.motion, np.concatenate([before.values, slow.solution.values[10:]]))
    parent = np.concatenate([before.parent, seen.parent[10:]])
    given = seen, start, parent, before.belief, 10
    same(refining.continued(*given), solver.continued(*given), atol=0.02)


@pytest.mark.compiler
@pytest.mark.parametrize(
    ("family", "whole"), [("prismatic", True), ("revolute", True), ("spherical", True), ("revolute", False)]
)
def test_precise_positions_are_the_same(family: str, whole: bool) -> None:
    seen = precise(family, whole)
    begin = [*starts(family, Overview(seen))]
    slow, fast = refining.likeliest(seen, begin), solver.likeliest(seen, begin)
    same(slow, fast, atol=0.02)
    near = slow.solution
    same(refining.refined(seen, near), solver.refined(seen, near), atol=0.02, log=0.2)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", [*HOW, "precise"])
def test_c_stays_within_the_memory_it_asks_for(
    family: str, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lent = []

    def lend(size: int) -> np.ndarray:
        lent.append(np.full(size + 64, 12345.0))
        return lent[-1][:size]

    monkeypatch.setattr(native._memory, "of", lend)
    seen = precise(family, True) if how == "precise" else seen_as(how, family)
    found = solver.likeliest(seen, [*starts(family, Overview(seen))]).solution
    found = solver.refined(seen, found).solution
    solver.continued(seen, Start(found.motion, found.values), found.parent, found.belief, 2)
    solver.evidence(found)
    assert len(lent) == 4
    assert all((memory[-64:] == 12345.0).all() for memory in lent)


@pytest.mark.compiler
@pytest.mark.parametrize("family", [*JOINTS])
@pytest.mark.parametrize("how", HOW)
def test_evidence_agrees(family: str, how: str) -> None:
    seen = seen_as(how, family)
    solution = solver.likeliest(seen, [*starts(family, Overview(seen))]).solution
    for scale in (1.0, 3.0):
        slow, fast = evidence(solution.scaled(scale)), solver.evidence(solution, scale)
        assert fast.log_evidence == pytest.approx(slow.log_evidence, rel=1e-9)
        assert solver.log_evidences(solution, np.array([scale])) == pytest.approx(slow.log_evidence, rel=1e-9)
        np.testing.assert_allclose(slow.covariance, fast.covariance, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(slow.joint_values, fast.joint_values, atol=1e-9)
        np.testing.assert_allclose(slow.joint_covariances, fast.joint_covariances, atol=1e-12)


@pytest.mark.compiler
@pytest.mark.parametrize("family", ["revolute", "planar"])
def test_what_steps_have_not_reached_does_not_count_in_c_either(family: str) -> None:
    seen = seen_as("both noisy", family)
    near = solver.likeliest(seen, [*starts(family, Overview(seen))])
    reached = solver.refined(seen, near.solution)
    early = replace(reached.solution, converged=False, cost=reached.solution.cost + 20.0)
    # Its widths have settled, so no step is taken.
    slow, fast = refining.refined(seen, early), solver.refined(seen, early)
    assert overrated(early) == pytest.approx(10.0, abs=0.5)
    assert fast.log_evidence == pytest.approx(slow.log_evidence, abs=1e-6)
    assert fast.log_evidence == pytest.approx(reached.log_evidence - overrated(early), abs=1e-3)


@dataclass(frozen=True)
class Pinned(GroupMotion):
    """A hinge of which only the axis is unknown."""

    @property
    def freedom(self) -> Freedom:
        return Freedom((5,), (3, 4), ())


@pytest.mark.compiler
def test_c_has_nothing_to_do_with_motions_that_are_not_what_their_group_says() -> None:
    seen = seen_as("both noisy", "revolute")
    start = next(starts("revolute", Overview(seen)))
    pinned = Pinned(GROUPS["revolute"], 6, start.motion.left, start.motion.right)
    begin = Start(pinned, start.values)
    assert not pinned.is_plain
    assert pinned.at(start.values).by_parameters.shape == (12, 6, 2)
    found = solver.likeliest(seen, [begin]).solution
    assert found.cost == pytest.approx(solve(seen, *begin).cost)
    assert solver.evidence(found).covariance.shape == (2, 2)


@pytest.mark.compiler
@pytest.mark.parametrize(
    "freedom",
    [
        Freedom((5,), tuple(range(6)), tuple(range(6))),
        Freedom((5,), (0, 1, 2, 3, 4, 5, 0), ()),
        Freedom((6,), (), ()),
    ],
    ids=["too many", "more than there are", "no such component"],
)
def test_c_refuses_groups_it_has_no_room_for(freedom: Freedom) -> None:
    group = replace(GROUPS["revolute"], poses=freedom, positions=freedom)
    assert not GroupMotion(group, 6, np.eye(4), np.eye(4)).is_plain
    assert GroupMotion(GROUPS["revolute"], 6, np.eye(4), np.eye(4)).is_plain


@pytest.mark.compiler
def test_joint_values_of_another_shape_are_refused() -> None:
    motion = GroupMotion(GROUPS["revolute"], 6, np.eye(4), np.eye(4))
    with pytest.raises(ShapeError, match=r"\(N, 1\), not \(4, 2\)"):
        motion.at(np.zeros((4, 2)))


@pytest.mark.compiler
@pytest.mark.parametrize("family", ["prismatic", "revolute", "planar"])
def test_without_a_compiler_the_same_is_found(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = recording(family, count=12, position=0.02, orientation=0.05, seed=1)
    fast = identify(seen.parent, seen.child, noise=seen.covariance)
    with monkeypatch.context() as patched:
        patched.setattr(library, "_code", None)
        patched.setattr(library, "_hopeless", True)
        slow = identify(seen.parent, seen.child, noise=seen.covariance)
        assert not solver.is_native
        best = slow.best
    assert fast.probabilities == pytest.approx(slow.probabilities, rel=0.02, abs=1e-4)
    assert fast.best.family == best.family
    np.testing.assert_allclose(fast.best.covariance, best.covariance, rtol=0.05, atol=1e-6)
    np.testing.assert_allclose(fast.best.joint_values, best.joint_values, atol=0.02 * best.deviations.max())
