"""Trials of skills in simulated worlds: outcomes judged by the truth, and robots put at handles."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.grasping import Gripper, Handle
from kineverse.state import State
from kineverse.worlds import RunMetrics, SimulatedWorld

from .opening.approach_planner import Opener
from .opening.base_placement import BasePlacement
from .opening.contact_phases import PhasePlanner
from .outcome import Outcome
from .session import Session

_SHORT_WAY, _SHORT_TURN = 0.03, math.radians(6.0)
"""Distance [m] and angle [rad] by which a part may be less open than the skill believes."""


@dataclass(frozen=True, slots=True)
class JudgedOutcome(Outcome):
    """Outcome of a skill in a simulated world, whose value is the true one.

    It is done if the skill claims it, it is true, and nothing overlapped on the way.

    Attributes
    ----------
    claimed
        Whether the skill believes that it is done.

    See Also
    --------
    kineverse.manipulation.open_object
    """

    claimed: bool = False


def judge_outcome(outcome: Outcome, metrics: RunMetrics) -> JudgedOutcome:
    """Return the outcome of a skill as the metrics of its run have it.

    The object has to be where it was wanted; a part whose motion is measured, as far open as the skill says.

    Parameters
    ----------
    outcome
        What the skill believes; its measures ``target`` and ``tolerance`` say where the object was wanted.
    metrics
        Metrics of the run, with the coordinate of the object. Their measures are added, and the ``way`` and
        the ``turn`` of a part replace what the skill believes of them.

    See Also
    --------
    kineverse.manipulation.open_object
    """
    value, overlap, objections = metrics.value, metrics.overlap, list[str]()
    measures = {**metrics.measures, **outcome.measures}
    target, tolerance = measures.get("target", math.nan), measures.get("tolerance", math.nan)
    if abs(value - target) > tolerance:
        objections.append(f"The world says {value:.4g}, not {target:.4g} ± {tolerance:.2g}.")
    if not math.isnan(metrics.way):
        way, turn = measures.get("way", 0.0), measures.get("turn", 0.0)
        measures |= {"way": metrics.way, "turn": metrics.turn}
        if metrics.way < way - _SHORT_WAY or metrics.turn < turn - _SHORT_TURN:
            opened = f"{100 * metrics.way:.0f} cm and {math.degrees(metrics.turn):.0f}°"
            objections.append(f"The world says that it is open by {opened}.")
    if math.isnan(value - target - tolerance) and math.isnan(metrics.way):
        objections.append("No truth was measured: metrics need the coordinate of the object, or its part.")
    if not metrics.is_complete:
        objections.append("The run was not measured: give its metrics to the session, as on_step=.")
    if not outcome:
        objections = []  # the skill has said why
    if overlap is not None:
        objections.append(str(overlap))
    done, reason = outcome.done and not objections, outcome.reason
    if objections:
        reason = " ".join([f"{reason.removesuffix('.')}.", *objections])
    if outcome and not done:
        measures["failure"] = "other" if overlap is None else "collision"
    return JudgedOutcome(
        done, outcome.value if math.isnan(value) else value, reason, outcome.world, outcome.seconds,
        outcome.steps, measures, outcome.done,
    )  # fmt: skip


def stand_at_handle(
    session: Session,
    world: SimulatedWorld,
    handle: Handle,
    target: float,
    *,
    gripper: Gripper | None = None,
    placements: int = 600,
    seed: int = 0,
) -> bool:
    """Put a base on wheels that does not drive by itself to where the hand takes a handle first.

    It is put there by a reset of the world. Others stay where they are: they drive in the skill.

    Parameters
    ----------
    session
        The robot in the world.
    world
        The world, whose state is read.
    handle
        Handle of the object.
    target
        Wanted value of the object's coordinate [m], [rad].
    gripper
        The likeliest one by default.
    placements, seed
        As for :func:`.open_object`.

    Returns
    -------
    bool
        Whether the world was reset.

    See Also
    --------
    kineverse.manipulation.open_object
    """
    state = world.state
    opener = Opener.of(session.robot, gripper or session.robot.gripper(), state)
    search, approaches = opener.search, opener.approaches
    if not approaches.explain_standing(state):
        return False

    def place(placement: BasePlacement) -> State:
        base = zip(placement.coordinates, placement.approach.tolist(), strict=True)
        return state.updated({s: v for s, v in base if s in search.standing})

    phase = PhasePlanner(session.model, session.robot, handle).find_next(state, target)
    found = search.find(
        state,
        opener.grasps(handle, state, seed),
        phase.way if phase.handle is handle else target,
        accept=lambda placement: bool(approaches.plan_to(place(placement), placement, seed)),
        samples=placements,
        seed=seed,
    )
    if found:
        world.reset(place(found))
        session.refresh()
    return bool(found)
