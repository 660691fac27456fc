"""All that was measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from .accuracy import FILTERS, REPORTED_MAX, REPORTED_MEAN, Errors
from .consistency import Consistency
from .durations import REPORTED, Duration
from .mechanisms import Followed
from .protocol import OBSERVATIONS, Noise, Scene


@dataclass(frozen=True)
class Results:
    """What was measured, see the modules of this package.

    Attributes
    ----------
    model, scene
        What was tracked.
    seeds, configurations
        How often, and how many configurations each time.
    errors, variants, consistency, mechanisms
        See :mod:`.accuracy`, :mod:`.consistency`, :mod:`.mechanisms`.
    by_size, by_noise
        Times by degrees of freedom, and by noise with all of them.
    """

    model: str
    scene: Scene
    seeds: tuple[int, ...]
    configurations: int
    errors: tuple[Errors, ...]
    variants: Mapping[str, list[float]]
    by_size: list[tuple[int, dict[str, Duration]]]
    by_noise: list[tuple[Noise, dict[str, Duration]]]
    consistency: Mapping[Noise, dict[str, Consistency]]
    mechanisms: list[Followed]

    def numbers(self) -> dict[str, Any]:
        """Return all of it as JSON has it: by filter, with null for what has no value."""
        return {
            "model": self.model,
            "degrees_of_freedom": len(self.scene.symbols),
            "symbols": [str(s) for s in self.scene.symbols],
            "seeds": list(self.seeds),
            "configurations": self.configurations,
            "observations": OBSERVATIONS,
            "errors": [
                {
                    **_plain(errors.noise),
                    **{who: {**errors.summary(who), "nees": errors.nees[who]} for who in FILTERS},
                    "reported_mean": mean,
                    "reported_max": largest,
                }
                for errors, mean, largest in zip(self.errors, REPORTED_MEAN, REPORTED_MAX, strict=True)
            ],
            "by_degrees_of_freedom": [
                {"degrees_of_freedom": dof, **{who: self._at_size(dof, times[who], who) for who in FILTERS}}
                for dof, times in self.by_size
            ],
            "milliseconds_by_noise": [
                {**_plain(noise), **{who: asdict(times[who]) for who in FILTERS}}
                for noise, times in self.by_noise
            ],
            "variants": dict(self.variants),
            "consistency": [
                {**_plain(noise), **{who: c.plain() for who, c in by_filter.items()}}
                for noise, by_filter in self.consistency.items()
            ],
            "mechanisms": [
                {
                    "mechanism": f.mechanism,
                    **_plain(f.noise),
                    **{who: _without_nan(asdict(f.by_filter[who])) for who in FILTERS},
                }
                for f in self.mechanisms
            ],
            "paper": {"milliseconds_below": REPORTED},
        }

    def _at_size(self, dof: int, time: Duration, who: str) -> dict[str, Any]:
        errors = [e.summary(who, slice(dof)) for e in self.errors]
        return {"errors": errors, "milliseconds": asdict(time)}


def _plain(noise: Noise) -> dict[str, float]:
    return {"position": noise.position, "orientation": noise.orientation}


def _without_nan(values: Mapping[str, float]) -> dict[str, float | None]:
    return {key: None if math.isnan(value) else value for key, value in values.items()}
