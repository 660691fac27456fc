"""Worlds in which skills are tried: they know nothing of controllers (layer 5)."""

from .sensor_sampler import SensorSampler
from .sensors import Sensors
from .world import Contact, Observation, World

__all__ = ["Contact", "Observation", "SensorSampler", "Sensors", "World"]
