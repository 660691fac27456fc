"""What touches in a model, as far as distances can be computed here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from kineverse.cli.findings import Finding
from kineverse.cli.table import figure
from kineverse.errors import KineverseError
from kineverse.geometry import Closest, Scene
from kineverse.geometry.left_out import is_installed, unusable
from kineverse.geometry.solids import coal_engine
from kineverse.model.view import ModelView

TOUCHING = 1e-5
"""What is less deep than this only touches, as a drawer lies on its rail [m]."""


def contacts(model: ModelView) -> Sequence[Closest] | None:
    """Return the pairs that touch or penetrate at the default state, deepest first; None if nobody can say.

    Shapes that cannot be used are left out. Nobody can say without the extra ``geometry``, or where
    there are no poses at the default state.
    """
    if not is_installed():
        return None
    try:
        return _touching(model)
    except KineverseError:  # What is not finite there is reported for itself.
        return None


def penetrations(model: ModelView) -> Iterator[Finding]:
    """Yield the pairs of bodies that are in each other at the default state.

    Raises
    ------
    MissingExtraError
        If the extra ``geometry`` is not installed.
    """
    coal_engine()
    for pair in contacts(model) or ():
        if pair.distance < -TOUCHING:
            text = f"in {pair.b} by {figure(-pair.distance, 3)} m at the default state"
            yield Finding("contact", pair.a, text)


def _touching(model: ModelView) -> Sequence[Closest]:
    scene = Scene(model, leave_out=unusable(model))
    scene.update(model.default_state())
    return scene.within(0.0)
