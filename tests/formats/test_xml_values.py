"""Numbers and poses as descriptions write them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kineverse.formats.poses import pose_from_quaternion, pose_from_rpy
from kineverse.formats.xml_values import parse_number, parse_numbers

FINITE = st.floats(allow_nan=False, allow_infinity=False)
ANGLE = st.floats(-10, 10)


@given(FINITE)
def test_every_finite_number_is_read_to_the_bit(value):
    assert parse_number(repr(value)) == value
    assert parse_number(f"  {value!r}\n") == value


@given(st.lists(st.floats(-1e50, 1e50), min_size=3, max_size=3))
def test_vectors_are_read(values):
    assert parse_numbers(" \t".join(map(repr, values)), 3) == tuple(values)


@pytest.mark.parametrize("text", ["1", "+1", "-1.", ".5", "1e-3", "1E3", "007"])
def test_number_spellings_are_read(text):
    assert parse_number(text) == float(text)


@pytest.mark.parametrize(("text", "value"), [("0x10", 16.0), ("-0x1.8p1", -3.0), ("0XA", 10.0)])
def test_hexadecimal_numbers_are_read_as_in_c(text, value):
    assert parse_number(text) == value


@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "nan",
        "-inf",
        "Infinity",
        "1e999",
        "1_000",
        "1,5",
        "١",
        "1d5",
        "one",
        "1 2",
        "--1",
        "1e",
        "1" * 2000,
    ],
)
def test_other_spellings_are_refused_with_a_reason(text):
    with pytest.raises(ValueError, match="a finite number is expected"):
        parse_number(text)


@given(st.tuples(ANGLE, ANGLE, ANGLE))
def test_rpy_angles_are_about_fixed_axes(rpy):
    expected = Rotation.from_euler("xyz", rpy).as_matrix()
    assert np.allclose(pose_from_rpy((1.0, 2.0, 3.0), rpy).matrix[:3, :3], expected, atol=1e-14)
    assert np.array_equal(pose_from_rpy((1.0, 2.0, 3.0), rpy).matrix[:3, 3], [1, 2, 3])


@given(st.tuples(ANGLE, ANGLE, ANGLE, ANGLE).filter(lambda q: math.hypot(*q) > 1e-3))
def test_quaternions_are_normalized(xyzw):
    expected = Rotation.from_quat(xyzw).as_matrix()
    assert np.allclose(pose_from_quaternion((0.0, 0.0, 0.0), xyzw).matrix[:3, :3], expected, atol=1e-13)


@pytest.mark.parametrize("quarters", [(1, 0, 0), (0, 1, 0), (1, 1, 1), (2, 3, 1), (-1, 2, -3), (4, 0, 2)])
def test_quarter_turns_are_exact(quarters):
    entries = pose_from_rpy((0.0, 0.0, 0.0), tuple(math.pi / 2 * n for n in quarters)).rows
    assert set(entries) <= {-1.0, 0.0, 1.0}
    # No -0.0, which would print as such.
    assert all(math.copysign(1.0, entry) == 1.0 for entry in entries if entry == 0.0)


def test_other_angles_are_not_snapped():
    assert pose_from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, 1.5708)).rows[0] == math.cos(1.5708)
