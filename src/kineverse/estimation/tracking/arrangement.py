"""From what is observed of a model to what is estimated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kineverse.model.rates import plain
from kineverse.symbols import Symbol

from .chart import chart_of
from .layout import Layout, layout_of
from .limits import Limits, limits_of
from .observed import Observation

if TYPE_CHECKING:
    from kineverse.model.view import ModelView


def arranged(
    model: ModelView, seen: tuple[Observation, ...], handed: frozenset[Symbol]
) -> tuple[Layout, Limits]:
    """Return what is estimated, and the limits of that.

    Parameters
    ----------
    model, seen
        What is tracked, and what is observed of it.
    handed
        The coordinates that are measured elsewhere.

    Raises
    ------
    ValueRejectedError
        If an observation depends on nothing that could be estimated.
    """
    rates = model.rates
    values = [rates.resolve(plain(one.value)) for one in seen]
    chart = chart_of(rates, values, handed, model.default_state())
    limits = limits_of(model, chart, handed)
    looked_at = {s for value in values for s in value.symbols}
    looked_at |= {s for c in limits.curved for s in c.symbols}
    looked_at |= {s for x in chart.coordinates if x in rates for e in rates[x].values() for s in e.symbols}
    inputs = sorted(looked_at - set(chart.coordinates), key=lambda s: s.sort_key)
    return layout_of(chart, seen, limits.curved, inputs), limits
