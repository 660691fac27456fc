"""Worlds in which skills are tried: they know nothing of controllers (layer 5)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .kinematic_world import Event as Event, KinematicWorld as KinematicWorld
    from .mechanism_world import MechanismWorld as MechanismWorld
    from .mujoco_world import MujocoWorld as MujocoWorld
    from .recorder import Recorder as Recorder
    from .recording import RunRecording as RunRecording, read_run_recording as read_run_recording
    from .run_metrics import Judge as Judge
    from .sensor_sampler import SensorSampler as SensorSampler
    from .sensors import Sensors as Sensors
    from .world import Contact as Contact, Observation as Observation, World as World

lazy_face(__name__)
