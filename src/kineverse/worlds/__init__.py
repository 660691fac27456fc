"""Worlds in which skills are tried: they know nothing of controllers (layer 5)."""

from .kinematic_world import Event, KinematicWorld
from .recorder import Recorder
from .recording import RunRecording, read_run_recording
from .sensor_sampler import SensorSampler
from .sensors import Sensors
from .world import Contact, Observation, World

__all__ = [
    "Contact",
    "Event",
    "KinematicWorld",
    "Observation",
    "Recorder",
    "RunRecording",
    "SensorSampler",
    "Sensors",
    "World",
    "read_run_recording",
]
