"""The order in which a model shows its values is that of a model built anew, whatever was edited before."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.document import to_json
from kineverse.model.operation import KINDS

NAMES = "abcd"


@dataclass(frozen=True)
class Several(kv.Operation):
    """Writes data, and frames beside them, in the order given; may ask what there is before."""

    overrides = True

    names: tuple[str, ...]
    asks: str = ""

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        chosen = self.names if self.asks in model.data else self.names[::-1]
        return kv.model.Writes(
            data=dict.fromkeys(chosen, 1),
            frames={f"f{n}": ("world", kv.translation(1, 0, 0)) for n in chosen},
        )


def shown(model: kv.Model) -> list[list[str]]:
    return [list(model.data), list(model.frames), *(list(model.snapshot()._head[kind]) for kind in KINDS)]


def fold(sequence: list[tuple[str, kv.Operation]]) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for tag, operation in sequence:
            edit.apply(operation, tag)
    return model


operations = st.builds(
    Several,
    st.lists(st.sampled_from(NAMES), unique=True, max_size=4).map(tuple),
    st.sampled_from(["", *NAMES]),
)
step = st.tuples(
    st.sampled_from(["append", "insert", "replace", "replace", "remove"]),
    st.integers(0, 9),
    operations,
    st.booleans(),
)


@settings(max_examples=attempts(30))
@given(st.lists(st.tuples(st.lists(step, min_size=1, max_size=3), st.booleans()), max_size=8))
def test_random_edits(transactions: list[tuple[list[tuple[str, int, Several, bool]], bool]]) -> None:
    model, sequence, count = kv.Model(), list[tuple[str, kv.Operation]](), 0
    for steps, refused in transactions:
        wanted = list(sequence)
        try:
            with model.edit() as edit:
                for what, place, operation, look in steps:
                    count += 1
                    i = place % len(wanted) if wanted else 0
                    if what == "append" or not wanted:
                        edit.apply(operation, f"t{count}")
                        wanted.append((f"t{count}", operation))
                    elif what == "insert":
                        edit.insert(operation, f"t{count}", before=wanted[i][0])
                        wanted.insert(i, (f"t{count}", operation))
                    elif what == "replace":
                        edit.replace(wanted[i][0], operation)
                        wanted[i] = (wanted[i][0], operation)
                    else:
                        edit.remove(wanted[i][0])
                        del wanted[i]
                    if look:
                        assert shown(model) == shown(fold(wanted))
                if refused:
                    raise kv.errors.ModelError("refused")
        except kv.errors.ModelError:
            wanted = sequence
        sequence = wanted
        again = fold(sequence)
        assert shown(model) == shown(again)
        assert to_json(model) == to_json(again)


@pytest.mark.parametrize(("before", "after"), [("b", "ab"), ("ab", "ba"), ("abc", "ca"), ("", "ab")])
@pytest.mark.parametrize("last", [True, False])
def test_a_replaced_operation_writes_in_its_new_order(before: str, after: str, last: bool) -> None:
    behind = [] if last else [("end", Several(("d",), ""))]
    model = fold([("one", Several(tuple(before))), *behind])
    with model.edit() as edit:
        edit.replace("one", Several(tuple(after)))
    assert shown(model) == shown(fold([("one", Several(tuple(after))), *behind]))
