"""One articulation beside what else could be there, and what is proposed instead."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError
from kineverse.estimation.identification.fit import SURE, Found
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.pairs import LOG_ANYWHERE, Families, identified
from kineverse.estimation.tracking.outliers import Outliers
from kineverse.model.model import Model
from kineverse.model.operation import Operation

from .astray import credible
from .before import follows_another
from .earlier import explained
from .evidence import log_elsewhere, log_evidence
from .links import Link
from .misfit import Misfit, misfit
from .proposal import proposal
from .report import Rating
from .served import Served

BELIEFS: Mapping[str, float] = MappingProxyType(
    {"served": 0.8, "elsewhere": 0.05, "rigid": 0.1, "other": 0.05}
)
"""How probable it is beforehand that an articulation is as served, that it or what is on it sits a bit
elsewhere, that it does not move, or that it is something else."""

# Fewer observations do not show how something moves.
_ENOUGH = 5


@dataclass(frozen=True)
class Seen:
    """A link and how it was seen.

    Attributes
    ----------
    observations
        Of both frames.
    misfit
        What of them the articulation does not explain.
    times
        The numbers of the observations, (N,).
    """

    link: Link
    served: Served
    observations: Observations
    misfit: Misfit
    times: npt.NDArray[np.int_]

    def at(self, rows: slice | npt.NDArray[np.int_]) -> Seen:
        """Return some of the times at which it was seen."""
        return Seen(
            self.link, self.served, self.observations.at(rows), self.misfit.at(rows), self.times[rows]
        )


def judged(
    model: Model, seen: Seen, stopped: int | None, families: Families, outliers: Outliers | None
) -> Rating:
    """Return the rating of an articulation, given since when it does not explain what is seen."""
    if stopped is None:
        since = seen
        right = credible(seen.misfit, outliers)
    else:
        since = seen.at(slice(int(np.searchsorted(seen.times, stopped)), None))
        right = np.arange(len(since.times))
        if outliers is not None and len(right) >= 2:
            right = identified(since.observations, families, outliers).best.right
    good = since.at(right)
    instead = identified(good.observations, families) if len(right) >= 2 else None
    probabilities = _probabilities(good, instead)
    operation, reason = None, ""
    if stopped is not None:
        operation, reason = _proposed(model, seen, good, instead)
    else:
        reason = _doubt(probabilities, len(right))
    squares = np.mean(good.misfit.residuals**2, axis=0)
    rms = math.sqrt(float(squares[:3].sum())), math.sqrt(float(squares[3:].sum()))
    wrong = tuple(np.setdiff1d(since.times, good.times).tolist())
    return Rating(seen.link, probabilities, rms, len(seen.times), stopped, instead, operation, reason, wrong)


def _probabilities(seen: Seen, instead: Found | None) -> dict[str, float]:
    served, left = seen.served, seen.misfit
    as_served = log_evidence(served, left)
    logs = {
        "served": math.log(BELIEFS["served"]) + as_served,
        "elsewhere": math.log(BELIEFS["elsewhere"]) + as_served + log_elsewhere(left),
        "rigid": -math.inf,
    }
    if served.joints:
        logs["rigid"] = math.log(BELIEFS["rigid"]) + log_evidence(served, left, still=True)
    # A family's probability is its evidence times its belief beforehand, up to what is common to all.
    for fit in instead or ():
        if fit.probability > 0.0 and instead is not None:
            odds = math.log(BELIEFS["other"]) + math.log(fit.probability / instead.best.probability)
            log = odds + instead.best.log_evidence + LOG_ANYWHERE
            logs[fit.family] = float(np.logaddexp(logs.get(fit.family, -math.inf), log))
    total = float(np.logaddexp.reduce(list(logs.values())))
    return {"free": 0.0, **{name: math.exp(log - total) for name, log in logs.items()}}


def _doubt(probabilities: Mapping[str, float], count: int) -> str:
    """Return what speaks against an articulation that explains what is seen."""
    if probabilities["served"] >= SURE:
        return ""
    if count < _ENOUGH:
        return f"both were seen {count} time{'s' if count > 1 else ''} only"
    other = max((name for name in probabilities if name != "served"), key=lambda name: probabilities[name])
    if other == "elsewhere":
        return "it may sit a bit elsewhere as well"
    return "it hardly moved" if other == "rigid" else f"it may be {other} as well"


def _proposed(model: Model, seen: Seen, since: Seen, instead: Found | None) -> tuple[Operation | None, str]:
    if instead is None or len(since.times) < _ENOUGH:
        return None, "it was seen too seldom since to say what it is instead"
    if not instead.best.told:
        return None, f"what it is instead is not known yet, {instead}"
    if not follows_another(model, seen.link) and _stands_alone(model, since, instead):
        # Another joint in its place would not help.
        return None, "by itself it explains what is seen, but not together with what limits or moves it"
    try:
        used = np.searchsorted(seen.times, since.times)
        rows, fit = explained(instead.best, seen.observations, used)
        coordinates = seen.served.beyond_limits(seen.observations, seen.misfit.coordinates)[rows]
        operation = proposal(model, seen.link, seen.served, coordinates, seen.misfit.others[rows], fit)
    except KineverseError as error:
        return None, f"what it is instead is no operation. {error}"
    try:
        with model.copy().edit() as edit:
            edit.replace(seen.link.tag, operation)
    except KineverseError as error:
        return None, f"what it is instead cannot take its place. {error}"
    return operation, ""


def _stands_alone(model: Model, seen: Seen, instead: Found) -> bool:
    """Whether an articulation explains what is seen without its ties to others, and with loops opened."""
    if not (seen.misfit.tied.size or seen.misfit.apart.size):
        return False
    served = Served(model, seen.link.child, seen.link.parent, opened=True)
    left = misfit(served, seen.observations)
    alone = _probabilities(Seen(seen.link, served, seen.observations, left, seen.times), instead)
    return alone["served"] >= SURE
