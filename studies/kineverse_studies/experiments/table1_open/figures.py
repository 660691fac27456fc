"""Pictures of openings: the three objects (2022 paper, Fig. 5), and a robot at the folding door (Fig. 7)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from kineverse.formats import load
from kineverse.manipulation.robot_sources import SHIPPED
from kineverse.model.model import Model
from kineverse.view.plots import Figure
from kineverse_studies.experiments.manipulation.film import FilmRow, choose_moments, make_film
from kineverse_studies.experiments.manipulation.trials import Trial

from .objects import OBJECT, OBJECTS, make_opening_setup

FILMED = "folding door"
"""Object whose opening is filmed."""
_PICTURES = 6
_SHARES = (0.0, 0.5, 1.0)


def make_opening_pictures(trials: Sequence[Trial]) -> dict[str, Figure]:
    """Return the picture of the objects, and the film of the opening by each shipped robot, by name."""
    found = {"objects": make_film([_object_row(name) for name in OBJECTS])}
    # Physics is nearer to the paper's real door than a world without forces.
    filmed = sorted(
        (t for t in trials if t.film and t.robot in SHIPPED and t.case == FILMED and t.skill == "open"),
        key=lambda t: (t.done, t.world == "mujoco"),
    )
    best = {t.robot: t for t in filmed}
    if best:
        found["folding-door"] = make_film([_robot_row(best[robot]) for robot in SHIPPED if robot in best])
    return found


def _object_row(name: str) -> FilmRow:
    thing = OBJECTS[name]
    what = f"{OBJECT}/{thing.coordinate}"
    model = load(thing.source, prefix=OBJECT)
    lower, upper = model.limits(what)
    values = [lower + share * (upper - lower) for share in _SHARES]
    labels = [f"{value:.2f}" for value in values]
    return FilmRow(name, lambda: model, [{what: value} for value in values], labels, (f"{OBJECT}/",))


def _robot_row(trial: Trial) -> FilmRow:
    chosen = choose_moments(trial.film, _PICTURES)
    return FilmRow(
        f"{trial.robot}, {trial.world} world",
        partial(_load, trial.robot, trial.case),
        [m.values for m in chosen],
        [f"{m.time:.1f} s, {m.phase}" for m in chosen],
        (f"{SHIPPED[trial.robot].prefix}/", f"{OBJECT}/"),
    )


def _load(robot: str, thing: str) -> Model:
    return make_opening_setup(SHIPPED[robot], OBJECTS[thing]).model
