"""Robots, trials and tables of the experiments about manipulation."""
