"""Robots, their interface, and simulated worlds that know nothing of controllers (layer 5)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .kinematic_world import Event as Event, KinematicWorld as KinematicWorld
    from .mechanism_world import MechanismWorld as MechanismWorld
    from .mujoco_world import MujocoWorld as MujocoWorld
    from .recorder import Recorder as Recorder
    from .recording import RunRecording as RunRecording, read_run_recording as read_run_recording
    from .robot import MobileBase as MobileBase, Robot as Robot
    from .robot_interface import (
        Observation as Observation,
        PlannedContact as PlannedContact,
        RobotInterface as RobotInterface,
    )
    from .run_metrics import RunMetrics as RunMetrics, RunOverlap as RunOverlap
    from .sensor_sampler import SensorSampler as SensorSampler
    from .sensors import Sensors as Sensors
    from .simulated_world import (
        ChangeableWorld as ChangeableWorld,
        Contact as Contact,
        ForceLimit as ForceLimit,
        SimulatedWorld as SimulatedWorld,
        TrueBelief as TrueBelief,
    )

lazy_face(__name__)
