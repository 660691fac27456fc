import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kineverse.cli.arguments import parse_assignments, parse_length, parse_value
from kineverse.errors import DuplicateNameError, InvalidValueError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.3", 0.3),
        ("-1", -1.0),
        ("+.5", 0.5),
        ("1e-2", 0.01),
        ("pi", math.pi),
        ("-pi", -math.pi),
        ("pi/2", math.pi / 2),
        ("-pi/4", -math.pi / 4),
        ("0.5*pi", math.pi / 2),
        ("2pi", 2 * math.pi),
        ("3*pi/4", 3 * math.pi / 4),
        ("1/3", 1 / 3),
        ("π", math.pi),
        ("30deg", math.pi / 6),
        ("-90 deg", -math.pi / 2),
        ("45°", math.pi / 4),
        ("1.5rad", 1.5),
        ("0.4m", 0.4),
        ("12cm", 0.12),
        ("5 mm", 0.005),
        (" 0.3 ", 0.3),
    ],
)
def test_parse_value_accepts_numbers_units_and_parts_of_pi(text, value):
    assert parse_value(text) == pytest.approx(value)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_parse_value_reads_numbers_exactly(value):
    assert parse_value(repr(value)) == value


@pytest.mark.parametrize(
    "text",
    [
        "",
        "nan",
        "NaN",
        "inf",
        "-inf",
        "Infinity",
        "1e999",
        "x",
        "1.2.3",
        "pi*",
        "*pi",
        "1/0",
        "pi pi",
        "0x10",
        "1,5",
        "--1",
        "1deg2",
        "deg",
        "1_000",
        "1\n2",
        "٣",
        "f(1)",
    ],
)
def test_parse_value_refuses_nonfinite_values(text):
    with pytest.raises(InvalidValueError, match=r"write|zero|finite"):
        parse_value(text)


def test_parse_assignments_keeps_names_unchanged():
    texts = ["kitchen/fridge_door=1", "a=b=0.1", "x:velocity=2"]
    assert parse_assignments(texts) == {"kitchen/fridge_door": 1.0, "a=b": 0.1, "x:velocity": 2.0}


@pytest.mark.parametrize("text", ["door", "=3", "  =3", "door=", ""])
def test_parse_assignments_refuses_invalid_texts(text):
    with pytest.raises(InvalidValueError):
        parse_assignments([text])


def test_parse_assignments_refuses_a_name_given_twice():
    with pytest.raises(DuplicateNameError, match="--set a is given twice"):
        parse_assignments(["a=1", "b=2", " a =1"])


@pytest.mark.parametrize(("text", "value"), [("0.05", 0.05), ("5 cm", 0.05), ("2mm", 0.002), ("1/4 m", 0.25)])
def test_parse_length_accepts_numbers_and_units(text, value):
    assert parse_length(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["30deg", "1rad", "pi", "3°", "", "far", "nan", "inf", "1e400", "1/0"])
def test_parse_length_refuses_invalid_texts(text):
    with pytest.raises(InvalidValueError):
        parse_length(text)
