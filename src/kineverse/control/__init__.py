"""Control: a QP velocity controller and inverse kinematics for any model (layer 5)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .command import Command as Command
    from .controller import Controller as Controller
    from .ik_solver import (
        IkResult as IkResult,
        InverseKinematics as InverseKinematics,
        inverse_kinematics as inverse_kinematics,
    )
    from .tasks import (
        Goal as Goal,
        Hold as Hold,
        Keep as Keep,
        Target as Target,
        Task as Task,
        look_at as look_at,
        same_orientation as same_orientation,
        same_pose as same_pose,
        same_position as same_position,
    )
    from .unlocking import unlock as unlock

lazy_face(__name__)
