"""Whatever a user gives, the error is one of the project's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse.formats.document import read_operations, to_json

a, b = kv.position("a"), kv.position("b")


def model() -> kv.Model:
    result = kv.Model()
    with result.edit() as edit:
        edit.constrain("c", 0, a, 1)
    return result


@pytest.mark.parametrize("version", [10**400, 10**4000, 10**7, 3])
def test_documents_of_later_versions(version: int) -> None:
    with pytest.raises(kv.errors.FormatError, match="this Kineverse reads version 2") as caught:
        read_operations(f'{{"format": "kineverse", "version": {version}, "operations": []}}')
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("path", [None, 5, ["x.kv.json"], "~nobody-has-this-name/x.kv.json", "x.json", ""])
def test_paths_to_save_to(path: Any) -> None:
    with pytest.raises(kv.errors.FormatError):
        model().save(path)


def test_bytes_are_a_path(tmp_path: Any) -> None:
    model().save(str(tmp_path / "x.kv.json").encode())
    assert kv.load(tmp_path / "x.kv.json").symbols == (a,)


def test_an_integer_too_long_for_a_document_is_refused() -> None:
    for datum in (10**5000, -(10**5000), (1, (10**5000,))):
        long = model()
        with long.edit() as edit:
            edit.write("long", datum)
        with pytest.raises(kv.errors.FormatError, match=r"data/long.*integer of 166\d\d bits"):
            to_json(long)


@pytest.mark.parametrize("value", [np.float64(0.1), np.float64("inf"), 10**3000, -1, True])
def test_data_that_come_back(value: Any) -> None:
    before, after = model(), kv.Model()
    with before.edit() as edit:
        edit.write("x", (value,))
    with after.edit() as edit:
        for tag, operation in read_operations(to_json(before)):
            edit.apply(operation, tag)
    assert after.data["x"] == (value,)
    assert to_json(after) == to_json(before)


@pytest.mark.parametrize("wrong", ["a", None, 1j, [0.1], 10**400, 0, -1, float("nan"), float("inf")])
def test_steps_and_gains(wrong: Any) -> None:
    with pytest.raises(kv.errors.InvalidValueError, match="dt"):
        model().velocity_rows(wrong)
    if wrong is not None:
        with pytest.raises(kv.errors.InvalidValueError, match="gain"):
            model().velocity_rows(0.1, gain=wrong)


@pytest.mark.parametrize("contrast", ["x", None, 0, 1j, float("nan"), [1]])
def test_contrasts(contrast: Any) -> None:
    with pytest.raises(kv.errors.InvalidValueError, match="contrast"):
        kv.logic.less(a, b, contrast)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a:" + "9" * 5000, "is not an order"),
        ("a:1", "write 'a:velocity'"),
        ("a:4", "write 'a:snap'"),
        ("a:0", "write 'a'"),
        ("a:position", "write 'a'"),
        ("x%3Ay:1", "write 'x%3Ay:velocity'"),
        ("a:٣", "is not an order"),
        ("a:05", "is not an order"),
        ("a:-5", "is not an order"),
        ("a:", "is not an order"),
        ("a:speed", "velocity, acceleration"),
    ],
)
def test_a_symbol_has_one_name(name: str, words: str) -> None:
    with pytest.raises(kv.errors.ExpressionError, match=words) as caught:
        kv.State({name: 1})
    assert len(str(caught.value)) < 400
    e = kv.array([kv.symbols.symbol(path, n) for path in ("a", "x:y") for n in range(7)])
    with pytest.raises(kv.KineverseError):
        e({name: 1})


def test_names_of_orders_are_read_as_they_are_written() -> None:
    for order in range(12):
        s = kv.symbols.symbol("x:y/z", order)
        assert dict(kv.State({str(s): 2.0})) == {s: 2.0}
        assert (2 * s)({str(s): 2.0}) == 4
