"""Models of constraints only."""

from __future__ import annotations

from typing import Any

import kineverse as kv


def model(**constraints: tuple[Any, Any, Any]) -> kv.Model:
    """Return a model with these constraints by name, and nothing else."""
    result = kv.Model()
    with result.edit() as edit:
        for name, (lower, expression, upper) in constraints.items():
            edit.constrain(name, lower, expression, upper)
    return result
