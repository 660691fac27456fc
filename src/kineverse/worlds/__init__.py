"""Worlds in which skills are tried: they know nothing of controllers (layer 5)."""

from .world import Contact, Observation, World

__all__ = ["Contact", "Observation", "World"]
