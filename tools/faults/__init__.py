"""Faults of the machine below a model server: damaged files, full disks, processes that are killed."""
