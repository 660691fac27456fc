"""Control: a QP velocity controller and inverse kinematics for any model (layer 5)."""

from .command import Command
from .controller import Controller
from .ik_solver import IkResult, InverseKinematics, inverse_kinematics
from .tasks import Goal, Hold, Keep, Target, Task, look_at, same_orientation, same_pose, same_position
from .unlocking import unlock

__all__ = [
    "Command",
    "Controller",
    "Goal",
    "Hold",
    "IkResult",
    "InverseKinematics",
    "Keep",
    "Target",
    "Task",
    "inverse_kinematics",
    "look_at",
    "same_orientation",
    "same_pose",
    "same_position",
    "unlock",
]
