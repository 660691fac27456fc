"""The list of what can be opened by name."""

from __future__ import annotations

import json

from kineverse.cli.table import table


def asked_for(model: str) -> bool:
    """Return whether it is the list that a user wants instead of a model."""
    from kineverse.formats.sources import GALLERY

    return model.rstrip("/") == GALLERY


def print_articulations(as_json: bool = False) -> int:
    """Print a line for each articulation, and return the exit status."""
    from kineverse import gallery
    from kineverse.formats.sources import GALLERY

    rows = [(f"{GALLERY}/{name}", gallery.summary(name)) for name in gallery.names()]
    if as_json:
        print(json.dumps({"models": [{"name": name, "shows": text} for name, text in rows]}))
    else:
        print(table(("model", "shows"), rows, "<<"))
        print(f"\nMove one with: kineverse view {rows[0][0]}")
    return 0


def print_models() -> int:
    """Print a line for each shipped model and each articulation, and return the exit status."""
    from kineverse.formats import shipped_models

    print("models: " + ", ".join(shipped_models()), end="\n\n")
    return print_articulations()
