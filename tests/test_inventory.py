"""The inventory of what a user meets (``tools/inventory``) tells differences, and no others."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

from inventory import commands, models, names  # noqa: E402  - it is no part of the package
from inventory.compare import compare  # noqa: E402

DOOR = "articulations/revolute"


@pytest.fixture(scope="module")
def inventory() -> dict:
    """Two small sections, as they are read from a file."""
    options = {key: entry for key, entry in commands.describe(["fk"]) if entry}
    sections = {"names": dict(names.describe("kineverse.errors")), "commands": options}
    return json.loads(json.dumps({**sections, "poses": {DOOR: models.describe_model(DOOR)}}))


def test_an_inventory_is_equal_to_itself(inventory, capsys):
    assert inventory["names"]["kineverse.errors:InfeasibleError"]["kind"] == "exception"
    assert inventory["commands"]["fk --json"]["default"] == "False"
    assert inventory["poses"][DOOR]["coordinates"] == ["revolute/door"]
    assert compare(inventory, copy.deepcopy(inventory), None) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(inventory)


@pytest.mark.parametrize(
    ("section", "key", "field", "value", "told"),
    [
        (
            "names",
            "kineverse.errors:suggest",
            "signature",
            "(x)",
            "changed kineverse.errors:suggest  signature",
        ),
        ("commands", "fk --json", "default", "True", "changed fk --json  default: False -> True"),
        ("poses", DOOR, "poses", [1, 2, 3], f"changed {DOOR}  poses"),
        ("poses", DOOR, "mass", 1e-12, ""),  # the last digits do not matter
        ("commands", "fk --json", "help", "other words", "reworded fk --json"),
        ("names", "kineverse.errors:suggest", None, None, "removed kineverse.errors:suggest"),
        ("names", "kineverse.errors:InfeasibleError", None, None, "removed kineverse.errors:InfeasibleError"),
    ],
)
def test_a_difference_is_told(inventory, capsys, section, key, field, value, told):
    after = copy.deepcopy(inventory)
    if field:
        after[section][key][field] = value
    else:
        del after[section][key]
    assert compare(inventory, after, 5) == ("changed" in told or "removed" in told)
    assert told in capsys.readouterr().out
    assert compare(after, inventory, 5) == ("changed" in told or "removed" in told)


def test_what_moves_is_no_loss(capsys):
    before = {"tests": {"tests/a.py::test_x[1]": {"assertions": 2}, "tests/a.py::test_y": {"assertions": 2}}}
    after = {"tests": {"tests/b.py::test_x[1]": {"assertions": 3}, "tests/a.py::test_y": {"assertions": 1}}}
    assert compare(before, after, 5) == 1
    out = capsys.readouterr().out
    assert "moved tests/a.py -> tests/b.py: 1" in out
    assert "changed tests/a.py::test_y  assertions: 2 -> 1" in out
    del before["tests"]["tests/a.py::test_y"], after["tests"]["tests/a.py::test_y"]
    assert compare(before, after, 5) == 0
