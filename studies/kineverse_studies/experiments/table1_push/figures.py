"""Pictures of pushes: vectors (2020, Fig. 5; 2022, Fig. 6), and robots at the fridge (2020, Fig. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from kineverse.manipulation.robot_sources import SHIPPED
from kineverse.model.model import Model
from kineverse.view.plots import Figure
from kineverse_studies.experiments.manipulation.film import (
    FilmRow,
    choose_moments,
    find_telling_moment,
    make_film,
    make_push_picture,
)
from kineverse_studies.experiments.manipulation.trials import Trial

from .objects import SHIPPED_KITCHEN, make_push_setup

FILMED = ("fridge door", "sink left upper drawer", "folding door")
"""Objects whose pushes are filmed; the first one is that of the film."""
_PICTURES = 5


def make_push_pictures(trials: Sequence[Trial]) -> dict[str, Figure]:
    """Return the pictures of shipped robots in the shipped kitchen, by name."""
    own = [t for t in trials if t.film and t.robot in SHIPPED and t.case == SHIPPED_KITCHEN]
    # Of several worlds the first counts.
    films = {(t.robot, str(t.measures["thing"])): t for t in reversed(own)}
    found = {}
    panels = []
    for thing in FILMED:
        telling = [(*find_telling_moment(t.film), robot) for (robot, of), t in films.items() if of == thing]
        _, moment, robot = max(telling, key=lambda found: found[0], default=(0.0, None, ""))
        if moment is not None:
            panels.append(
                (f"{robot} at the {thing}, {moment.time:.1f} s", partial(_load, robot, thing), moment)
            )
    if panels:
        found["vectors"] = make_push_picture(panels)
    rows = []
    for robot in SHIPPED:
        if (robot, FILMED[0]) in films:
            trial = films[robot, FILMED[0]]
            chosen = choose_moments(trial.film, _PICTURES)
            rows.append(
                FilmRow(
                    robot,
                    partial(_load, robot, FILMED[0]),
                    [m.values for m in chosen],
                    [f"{m.time:.1f} s" for m in chosen],
                    (f"{SHIPPED[robot].prefix}/", trial.what),
                )
            )
    if rows:
        found["fridge"] = make_film(rows)
    return found


def _load(robot: str, thing: str) -> Model:
    return make_push_setup(SHIPPED[robot], SHIPPED_KITCHEN, thing).model
