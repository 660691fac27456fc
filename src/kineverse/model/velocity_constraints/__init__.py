"""Constraints on velocities: limits of speeds, and rows that keep constraints over a time step."""
