"""Whatever is put into a field of an articulation: it works, or one error names the articulation."""

from __future__ import annotations

from dataclasses import fields
from inspect import isabstract
from typing import Any

import pytest

import kineverse as kv

NEEDED: dict[type[Any], dict[str, Any]] = {
    kv.articulations.Screw: {"pitch": 0.01},
    kv.articulations.Gearbox: {"driver": "motor", "ratio": 2},
    kv.articulations.RackAndPinion: {"driver": "motor", "radius": 0.1},
    kv.articulations.Cam: {"driver": "motor", "angles": (0, 1, 2), "values": (0, 1, 0)},
    kv.articulations.DifferentialDrive: {"radius": 0.1, "track": 0.5},
    kv.articulations.Ackermann: {"wheelbase": 1},
    kv.articulations.Mecanum: {"radius": 0.1, "track": 0.5, "wheelbase": 0.7},
}
KINDS = tuple(
    kind
    for name in kv.articulations.__all__
    if hasattr(kind := getattr(kv.articulations, name), "apply") and not isabstract(kind)
)
STRANGE = ["1", "two", float("nan"), -1, None, (), {}, (1, 2), object(), kv.position("q"), kv.Limits("a", 1)]
TEXTS = {"name", "parent", "child", "driver", "left", "right"}


def test_every_articulation_is_covered() -> None:
    assert {
        kv.Fixed,
        kv.articulations.Ball,
        kv.articulations.OmniBase,
        kv.articulations.FoldingDoor,
        kv.articulations.Ratchet,
        *NEEDED,
    } <= set(KINDS)
    assert len(KINDS) == 29


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_every_field_accepts_a_value_or_names_itself_in_the_error(kind: type[Any]) -> None:
    names = {field.name for field in fields(kind)}
    given = {"name": "thing", "parent": "world", **NEEDED.get(kind, {})}
    given |= {"child": "child of it"} if "child" in names else {}
    for field in sorted(names - {"dynamics"}):
        for strange in STRANGE:
            model = kv.Model()
            with model.edit() as edit:
                edit.apply(kv.Revolute(name="motor", parent="world", child="shaft"))
            before, refusal = model.snapshot(), None
            try:
                with model.edit() as edit:
                    edit.apply(kind(**{**given, field: strange}), tag="it")
                model.violations(kv.State({**model.default_state(), **dict.fromkeys(model.speeds, 0.0)}))
                model.fk(list(model.frames)[-1])
            except kv.KineverseError as error:
                refusal = str(error)
            if refusal is not None:
                assert "thing" in refusal or (field in ("name", "parent") and repr(strange) in refusal)
                assert model.snapshot() == before


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_text_in_a_numeric_field_is_refused(kind: type[Any]) -> None:
    given = {"name": "thing", "parent": "world", **NEEDED.get(kind, {})}
    names = {field.name for field in fields(kind)}
    given |= {"child": "child of it"} if "child" in names else {}
    for field in sorted(names - TEXTS - {"dynamics"}):
        model = kv.Model()
        with pytest.raises(kv.KineverseError, match="thing"), model.edit() as edit:
            edit.apply(kv.Revolute(name="motor", parent="world", child="shaft"))
            edit.apply(kind(**{**given, field: "1"}))
