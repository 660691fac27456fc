"""Manipulation: skills that open, close and push articulated objects with a robot (layer 5)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from kineverse.worlds import Robot as Robot

    from .articulated_objects import (
        ArticulatedObject as ArticulatedObject,
        find_articulated_objects as find_articulated_objects,
    )
    from .session import Belief as Belief, Session as Session
    from .opening import (
        BasePlacement as BasePlacement,
        PlacementSearch as PlacementSearch,
        open_object as open_object,
    )
    from .outcome import Outcome as Outcome, SkillError as SkillError
    from .pushing import push as push
    from .robot_placement import PlacedRobot as PlacedRobot, place_robot as place_robot
    from .skill_run import SkillRun as SkillRun
    from .belief import TrackedBelief as TrackedBelief
    from .trials import (
        JudgedOutcome as JudgedOutcome,
        judge_outcome as judge_outcome,
        stand_at_handle as stand_at_handle,
    )
    from .unknown_objects import open_unknown as open_unknown
    from .unlocking import (
        LockExploration as LockExploration,
        PartMover as PartMover,
        UnlockingExecution as UnlockingExecution,
        execute_unlocking as execute_unlocking,
        explore_locks as explore_locks,
    )

lazy_face(__name__)
