"""Chains of joints that follow joints are composed."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from urdf_texts import joint, robot

from kineverse.errors import FormatError
from kineverse.formats.mimic import MimicRelation
from kineverse.formats.urdf import parse_urdf

FACTOR = st.integers(-3000, 3000).map(lambda thousandths: thousandths / 1000)


def followers(factors, order):
    """Return a star of joints: ``j0`` moves by itself, each other one follows the one before it."""
    inside = [""] + [
        f'<mimic joint="j{i}" multiplier="{m!r}" offset="{o!r}"/>' for i, (m, o) in enumerate(factors)
    ]
    joints = [joint(f"j{i}", "l0", f"l{i + 1}", "continuous", text) for i, text in enumerate(inside)]
    return robot(*(joints[i] for i in order), links=len(joints) + 1)


@given(st.data())
def test_mimic_chain_is_the_composition_of_its_relations(data):
    factors = data.draw(st.lists(st.tuples(FACTOR, FACTOR), min_size=1, max_size=6))
    order = data.draw(st.permutations(range(len(factors) + 1)))
    q = data.draw(FACTOR)
    joints = {j.name: j for j in parse_urdf(followers(factors, order)).joints}
    value = q
    assert joints["j0"].mimic is None
    for i, (multiplier, offset) in enumerate(factors):
        value = multiplier * value + offset
        mimic = joints[f"j{i + 1}"].mimic
        assert mimic.leader == "j0"
        assert math.isclose(mimic.multiplier * q + mimic.offset, value, rel_tol=1e-9, abs_tol=1e-9)


def test_mimic_defaults_are_multiplier_one_and_offset_zero():
    text = robot(
        joint("a", "l0", "l1", "continuous", ""),
        joint("b", "l1", "l2", "continuous", '<mimic joint="a"/>'),
        links=3,
    )
    description = parse_urdf(text)
    assert description.joints[1].mimic == MimicRelation("a", 1.0, 0.0)
    assert description.dof == 1


def test_a_slider_may_follow_a_hinge():
    text = robot(
        joint("a", "l0", "l1", "continuous", ""),
        joint(
            "b", "l1", "l2", "prismatic", '<limit effort="1" velocity="1"/><mimic joint="a" multiplier=".1"/>'
        ),
        links=3,
    )
    assert parse_urdf(text).dof == 1


def test_mimic_cycles_are_refused_and_shown():
    def follow(name: str, i: int) -> str:
        return joint(name, "l0", f"l{i}", "continuous", f'<mimic joint="{"abc"[i % 3]}"/>')

    text = robot(*(follow(name, i + 1) for i, name in enumerate("abc")), links=4)
    with pytest.raises(FormatError, match='it mimics itself, by way of "a" -> "b" -> "c"'):
        parse_urdf(text, strict=True)
    read = parse_urdf(text)
    assert {joint.name: joint.mimic and joint.mimic.leader for joint in read.joints} == {
        "a": "c",
        "b": "c",
        "c": None,
    }
    assert 'by way of "a" -> "b" -> "c"' in read.remarks[0]
    assert read.remarks[0].endswith("; it moves by itself.")


def test_broken_mimic_chain_error_names_the_joint(caplog):
    text = robot(
        joint("a", "l0", "l1", "continuous", '<mimic joint="finger_jiont"/>'),
        joint("b", "l0", "l2", "continuous", '<mimic joint="a"/>'),
        joint("finger_joint", "l0", "l3", "continuous", ""),
        links=4,
    )
    with pytest.raises(FormatError, match=r"<mimic> of <joint name=\"a\">: .*Did you mean 'finger_joint'\?"):
        parse_urdf(text, strict=True)
    with caplog.at_level("WARNING", "kineverse.formats"):
        mimics = {joint.name: joint.mimic for joint in parse_urdf(text).joints}
        parse_urdf(text.replace("finger_jiont", "a"))  # a cycle is a remark
    assert mimics == {"a": None, "b": MimicRelation("a"), "finger_joint": None}
    (heard,) = caplog.messages
    assert '<joint name="a">: it mimics "finger_jiont"' in heard
    assert heard.endswith("; it moves by itself. Did you mean 'finger_joint'?")


def test_factors_that_overflow_are_refused():
    text = followers([(1e200, 0.0), (1e200, 0.0)], range(3))
    with pytest.raises(FormatError, match="overflow"):
        parse_urdf(text, strict=True)
    read = parse_urdf(text)
    assert [joint.mimic for joint in read.joints] == [None, None, None]
    assert all("overflow" in remark for remark in read.remarks)


def test_many_mimic_cycles_take_linear_time():
    text = robot(
        *(joint(f"j{i}", "l0", f"l{i + 1}", "continuous", f'<mimic joint="j{i}"/>') for i in range(3000)),
        links=3001,
    )
    assert len(parse_urdf(text).remarks) == 3000
