"""Figures of the experiments, drawn by ``kineverse reproduce``."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from skills import run_command

WIDTH = 720

STUDIES = {
    "fig3": "",
    "fig4": "--quick",
    "estimation-grid": "--quick",
}
"""Options of the experiments whose figures take little time; ``--quick`` for a short form."""


def draw_study(name: str) -> np.ndarray:
    """Return the figure of an experiment, (height, width, 3) bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "figure.png")
        run_command(f"reproduce {name} {STUDIES[name]} --figure {path}")
        image = Image.open(path).convert("RGB")
    height = round(image.height * WIDTH / image.width)
    return np.asarray(image.resize((WIDTH, height), Image.Resampling.LANCZOS))
