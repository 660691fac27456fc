"""Documents of every released version are read for ever, as the models that they were.

``released/version_N.kv.json`` is the model of :func:`document_models.rich_model`, and something that follows a
number, as the writer of that version wrote it, and ``released/version_N.values.json`` what it was worth then. They are never written anew; a new
version of the format adds two files (``python tests/documents/test_released.py``, with the version counted up).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.formats.document.structs import VERSION

FOLDER = Path(__file__).parent / "released"
VERSIONS = range(2, VERSION + 1)  # version 1 was never released, and is not read


def values_of(model: kv.Model) -> dict[str, Any]:
    """Return what a model is worth at one state: poses, bounds, expressions, and all gradients."""
    expressions = {f"pose of {frame}": model.fk(frame) for frame in sorted(model.frames)}
    for name, c in sorted(model.constraints.items()):
        expressions |= {f"lower {name}": c.lower, f"middle {name}": c.expression, f"upper {name}": c.upper}
    for what, e in list(expressions.items()):
        for heuristic in (True, False):
            kind = "trend" if heuristic else "fact"
            expressions |= {f"{kind} {k} of {what}": v for k, v in e.gradient(heuristic).items()}
    names = sorted({s for e in expressions.values() for s in e.symbols}, key=lambda s: s.sort_key)
    state = {s: 0.3 + 0.1 * np.sin(i) for i, s in enumerate(names)}
    return {
        "state": {str(s): float(v) for s, v in state.items()},
        "values": {what: np.asarray(e(state)).tolist() for what, e in sorted(expressions.items())},
        "data": {name: repr(value) for name, value in sorted(model.data.items())},
        "tags": model.history.tags,
    }


def flat(values: Any) -> list[float]:
    return [x for item in values for x in flat(item)] if isinstance(values, list) else [float(values)]


@pytest.mark.parametrize("version", VERSIONS)
def test_released_document_has_the_values_it_had(version: int) -> None:
    expected = json.loads((FOLDER / f"version_{version}.values.json").read_text("utf-8"))
    found = json.loads(json.dumps(values_of(kv.load(FOLDER / f"version_{version}.kv.json"))))
    assert found["tags"] == expected["tags"]
    assert found["data"] == expected["data"]
    assert found["state"] == expected["state"]
    assert list(found["values"]) == list(expected["values"])
    for what, value in expected["values"].items():
        # Another CasADi may round another way.
        np.testing.assert_allclose(
            flat(found["values"][what]), flat(value), rtol=1e-12, atol=1e-13, err_msg=what
        )


@pytest.mark.parametrize("version", VERSIONS)
def test_released_operations_are_rebuilt_and_rerun(version: int) -> None:
    """The one of a class that nobody has follows a change upstream, and the file says what made the others."""
    model = kv.load(FOLDER / f"version_{version}.kv.json")
    assert model.data["heavy"] == 3.0
    with model.edit() as edit:
        edit.replace(model.history.writers("data/weight")[0], kv.model.SetData("weight", 4.0))
    assert model.data["heavy"] == 8.0
    assert model.history.operation("the arm").parameters["axis"] == (1.0, 2.0, 3.0)


def test_every_released_version_has_a_document() -> None:
    assert sorted(p.name for p in FOLDER.iterdir()) == sorted(
        f"version_{v}.{end}" for v in VERSIONS for end in ("kv.json", "values.json")
    )


if __name__ == "__main__":
    from document_models import Doubled, rich_model

    written = rich_model()
    with written.edit() as following:
        following.write("weight", 1.5)
        following.apply(Doubled("weight", "heavy"), tag="follower")
    written.save(FOLDER / f"version_{VERSION}.kv.json")
    text = json.dumps(values_of(written), indent=1, allow_nan=True)
    (FOLDER / f"version_{VERSION}.values.json").write_text(text + "\n", "utf-8")
