"""Worlds in which skills are tried: they know nothing of controllers (layer 5)."""

from .kinematic_world import Event, KinematicWorld
from .mechanism_world import MechanismWorld
from .mujoco_world import MujocoWorld
from .recorder import Recorder
from .recording import RunRecording, read_run_recording
from .run_metrics import Judge
from .sensor_sampler import SensorSampler
from .sensors import Sensors
from .world import Contact, Observation, World

__all__ = [
    "Contact",
    "Event",
    "Judge",
    "KinematicWorld",
    "MechanismWorld",
    "MujocoWorld",
    "Observation",
    "Recorder",
    "RunRecording",
    "SensorSampler",
    "Sensors",
    "World",
    "read_run_recording",
]
