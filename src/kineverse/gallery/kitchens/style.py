"""Styles of kitchens: materials, handles and heights, drawn from a seed."""

from __future__ import annotations

import numpy as np

from .builder import Style
from .solids import BAR, BLACK_BAR, BRASS_BAR, Material

_WHITE, _CREAM = Material((0.94, 0.94, 0.92, 1.0), 680.0), Material((0.91, 0.88, 0.80, 1.0), 680.0)
_SAGE, _NAVY = Material((0.55, 0.64, 0.57, 1.0), 680.0), Material((0.22, 0.30, 0.42, 1.0), 680.0)
_GREY, _OAK = Material((0.50, 0.52, 0.54, 1.0), 680.0), Material((0.76, 0.60, 0.42, 1.0), 620.0)
_CLAY, _WALNUT = Material((0.70, 0.47, 0.38, 1.0), 680.0), Material((0.46, 0.32, 0.23, 1.0), 640.0)
_STONE, _SLATE = Material((0.72, 0.71, 0.69, 1.0), 1500.0), Material((0.28, 0.29, 0.31, 1.0), 1500.0)
_FRONTS = ((_WHITE, _OAK), (_SAGE, _CREAM), (_NAVY, _WHITE), (_GREY, _WHITE), (_OAK, _WHITE), (_CLAY, _CREAM))
_COUNTERS = (_OAK, _WALNUT, _STONE, _SLATE)
_BARS = (BAR, BLACK_BAR, BRASS_BAR)


def draw_style(rng: np.random.Generator) -> Style:
    """Return a style; handles are 8 to 16 mm thick, 25 to 45 mm off the front, and at most .4 m long."""
    front, tall = _FRONTS[int(rng.integers(len(_FRONTS)))]
    counter = round(float(rng.uniform(0.84, 0.89)), 3)
    worktop = round(counter + float(rng.choice((0.02, 0.03, 0.04))), 3)
    return Style(
        front=front,
        tall_front=front if rng.random() < 0.6 else tall,
        carcass=_CREAM,
        counter_material=_COUNTERS[int(rng.integers(len(_COUNTERS)))],
        bar=_BARS[int(rng.integers(len(_BARS)))],
        round_bar=bool(rng.random() < 0.5),
        thickness=round(float(rng.uniform(0.008, 0.016)), 4),
        clearance=round(float(rng.uniform(0.025, 0.045)), 4),
        length=round(float(rng.uniform(0.12, 0.4)), 3),
        travel=round(float(rng.uniform(0.35, 0.5)), 2),
        plinth=round(float(rng.uniform(0.08, 0.12)), 3),
        counter=counter,
        worktop=worktop,
        top=round(float(rng.uniform(2.0, 2.2)), 3),
        wall_cupboards=round(worktop + float(rng.uniform(0.45, 0.55)), 3),
    )
