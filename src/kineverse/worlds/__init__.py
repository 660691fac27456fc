"""Worlds in which skills are tried: they know nothing of controllers (layer 5)."""

from .mujoco_world import MujocoWorld
from .sensor_sampler import SensorSampler
from .sensors import Sensors
from .world import Contact, Observation, World

__all__ = ["Contact", "MujocoWorld", "Observation", "SensorSampler", "Sensors", "World"]
