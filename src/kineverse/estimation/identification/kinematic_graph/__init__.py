"""Kinematic graph of many parts (Sturm et al. 2011)."""
