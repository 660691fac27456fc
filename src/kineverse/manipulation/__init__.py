"""Manipulation: skills that open, close and push articulated objects with a robot (layer 5)."""
