"""Links and joints form one tree, of any shape and depth."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from urdf_texts import chain, joint, robot

import kineverse as kv
from kineverse.errors import FormatError
from kineverse.formats.urdf import parse_urdf
from kineverse.formats.urdf.operations import urdf_operations


@st.composite
def trees(draw: st.DrawFn) -> tuple[list[int], list[int]]:
    """Return the parent of each link but the first, and an order in which to write the joints."""
    parents = [draw(st.integers(0, i)) for i in range(draw(st.integers(0, 12)))]
    return parents, draw(st.permutations(range(len(parents))))


def tree_text(parents: list[int], order: list[int]) -> str:
    return robot(
        *(joint(f"j{i}", f"l{parents[i]}", f"l{i + 1}", "continuous", "") for i in order),
        links=len(parents) + 1,
    )


@given(trees())
def test_joints_come_from_the_root_outwards_in_the_order_of_the_file(tree):
    parents, order = tree
    description = parse_urdf(tree_text(parents, order))
    assert description.root == "l0"
    names = [j.name for j in description.joints]
    assert sorted(names) == sorted(f"j{i}" for i in order)
    known = {"l0"}
    for j in description.joints:
        assert j.parent in known
        known.add(j.child)
    for parent in set(parents):
        siblings = [f"j{i}" for i in order if parents[i] == parent]
        assert [name for name in names if name in siblings] == siblings


@given(trees(), st.data())
def test_additional_joint_is_refused_in_strict_mode(tree, data):
    parents, order = tree
    links = st.integers(0, len(parents))
    extra = joint("extra", f"l{data.draw(links)}", f"l{data.draw(links)}", "fixed", "")
    text = tree_text(parents, order).replace("</robot>", extra + "</robot>")
    with pytest.raises(FormatError, match="URDF describes trees only"):
        parse_urdf(text, source="r.urdf", strict=True)


@given(trees().filter(lambda tree: tree[0]), st.data())
def test_missing_joint_leaves_two_roots(tree, data):
    parents, order = tree
    gone = data.draw(st.sampled_from(order))
    with pytest.raises(FormatError, match=f"where one root is expected: .*l{gone + 1}"):
        parse_urdf(tree_text(parents, [i for i in order if i != gone]), strict=True)
    read = parse_urdf(tree_text(parents, [i for i in order if i != gone]))
    assert (read.root, *read.more_roots) == ("l0", f"l{gone + 1}")
    assert len(read.joints) == len(parents) - 1


def test_joints_of_missing_links_are_refused():
    with pytest.raises(FormatError, match=r"its parent link \"l7\" does not exist; .* Available: l0, l1"):
        parse_urdf(robot(joint("j", "l7", "l1"), links=2))
    with pytest.raises(
        FormatError, match=r"its child link \"base_lnk\" does not exist; .*Did you mean 'base_link'"
    ):
        parse_urdf(robot('<link name="base_link"/>', joint("j", "l0", "base_lnk"), links=1))


def test_a_second_parent_names_the_first():
    text = robot(joint("a", "l0", "l2"), joint("b", "l1", "l2"), links=3)
    message = '<joint name="b">: its child link "l2" has a parent already, by the joint "a" on'
    with pytest.raises(FormatError, match=message):
        parse_urdf(text, strict=True)
    # As urdfdom keeps the one with the last name.
    for first, second in (("a", "b"), ("b", "a")):
        text = robot(joint(first, "l0", "l2"), joint(second, "l0", "l2"), joint("c", "l0", "l1"), links=3)
        read = parse_urdf(text)
        assert {j.name for j in read.joints} == {"b", "c"}
        assert read.remarks[0].endswith('; "a" is left out.')


def test_cycle_error_shows_its_joints():
    text = robot(*(joint(f"j{i}", f"l{i}", f"l{(i + 1) % 3}") for i in range(3)), links=3)
    with pytest.raises(
        FormatError, match='line 5, <joint name="j0">: the joints "j0" -> "j1" -> "j2" lead in a circle'
    ):
        parse_urdf(text)


def test_cycle_beside_a_tree_is_left_out_with_a_remark():
    text = robot(joint("a", "l1", "l2"), joint("b", "l2", "l1"), joint("c", "l2", "l3"), links=4)
    with pytest.raises(FormatError, match='<joint name="a">: the joints "a" -> "b" lead in a circle'):
        parse_urdf(text, strict=True)
    read = parse_urdf(text)
    assert ([link.name for link in read.links], read.joints) == (["l0"], ())
    assert read.remarks[0].endswith("3 links that no root holds are left out.")


def test_joint_that_mimics_one_of_a_cycle_is_independent():
    circle = joint("a", "l1", "l1") + joint("b", "l0", "l2", "continuous", '<mimic joint="a"/>')
    (only,) = parse_urdf(robot(circle, links=3)).joints
    assert (only.name, only.mimic) == ("b", None)


def test_nameless_links_and_joints_are_named():
    text = robot('<link name=""/>', joint("j", "l0", "l1", "fixed").replace('name="j" ', ""), links=2)
    model = kv.Model()
    with model.edit() as edit:
        for operation in urdf_operations(parse_urdf(text)):
            edit.apply(operation)
    assert set(model.frames) == {"l0", "l1", "link"}
    assert set(model.articulations) == {"l0_l1"}


def test_link_that_is_its_own_parent_is_refused():
    with pytest.raises(FormatError, match="its child link is its own parent"):
        parse_urdf(robot(joint("j", "l0", "l0"), links=1))


def test_error_without_tree_names_joints_of_other_dialects():
    with pytest.raises(
        FormatError, match=r'Ignored, since URDF does not know it: <drake:joint name="j"> \(line 4\)'
    ):
        parse_urdf(robot('<drake:joint name="j" type="ball"/>', links=2), strict=True)


def test_further_roots_have_the_pose_of_the_first():
    text = robot(joint("j", "l0", "l1"), joint("k", "l2", "l3"), links=4)
    model = kv.Model()
    with model.edit() as edit:
        for operation in urdf_operations(parse_urdf(text), "p"):
            edit.apply(operation)
    state = {"p/j": 0.0, "p/k": 0.5}
    np.testing.assert_array_equal(model.fk("p/l2")(state), np.eye(4))
    assert model.fk("p/l3", "p/l2").symbols == (kv.position("p/k"),)


def test_fixed_joint_with_a_repeated_name_is_renamed():
    for kinds in (("fixed", "revolute"), ("revolute", "fixed")):
        text = robot(*(joint("j", "l0", f"l{i + 1}", kind) for i, kind in enumerate(kinds)), links=3)
        read = parse_urdf(text)
        assert {j.name: j.kind for j in read.joints} == {"j": "revolute", "j_2": "fixed"}
        with pytest.raises(FormatError, match="names are unique"):
            parse_urdf(text, strict=True)


def work(text: str) -> int:
    """Return the number of calls and lines that reading a text takes."""
    steps = 0

    def count(*_: object):
        nonlocal steps
        steps += 1
        return count

    before = sys.gettrace(), sys.getprofile()
    sys.settrace(count)
    sys.setprofile(count)
    try:
        parse_urdf(text)
    finally:
        sys.settrace(before[0])
        sys.setprofile(before[1])
    return steps


MIMIC = '<limit effort="1" velocity="1"/><mimic joint="j{before}"/>'
STAR = robot(*(joint(f"j{i}", "l0", f"l{i + 1}") for i in range(400)), links=401)


@pytest.mark.parametrize("inside", ['<limit effort="1" velocity="1"/>', MIMIC])
def test_tree_order_takes_linear_time(inside):
    def text(length: int) -> str:
        return chain(length, inside).replace('<mimic joint="j0"/>', "", 1)

    work(text(20))
    short, long = work(text(200)), work(text(800))
    assert long < 4.2 * short


def test_tree_order_time_does_not_depend_on_the_shape():
    line, star = work(chain(400)), work(STAR)
    assert abs(star - line) < 0.1 * line


def test_chain_of_thirty_thousand_links_is_read():
    length = 30_000
    text = chain(length, '<mimic joint="j{before}" multiplier="1" offset="1"/>', "continuous")
    text = text.replace('<mimic joint="j0" multiplier="1" offset="1"/>', "", 1)
    description = parse_urdf(text)
    assert len(description.links) == length + 1
    assert description.joints[-1].name == f"j{length - 1}"
    assert description.joints[-1].mimic.leader == "j0"
    assert description.joints[-1].mimic.offset == length - 1
    assert description.dof == 1


@pytest.mark.parametrize("prefix", [None, "r"])
def test_a_parent_world_without_a_link_is_the_world(prefix: str | None):
    text = robot('<link name="base"/>', joint("stand", "world", "base", "fixed", '<origin xyz="1 2 3"/>'))
    description = parse_urdf(text)
    assert (description.root, len(description.remarks)) == ("world", 1)
    assert 'its parent link "world" has no <link> element' in description.remarks[0]
    model = kv.Model()
    with model.edit() as edit:
        for operation in urdf_operations(description, prefix):
            edit.apply(operation)
    assert set(model.frames) == ({"base"} if prefix is None else {"r/world", "r/base"})
    np.testing.assert_array_equal(model.fk("base" if prefix is None else "r/base")()[:3, 3], [1, 2, 3])
    with pytest.raises(FormatError, match='its parent link "world" does not exist'):
        parse_urdf(text, strict=True)
    with pytest.raises(FormatError, match='its child link "world" does not exist'):
        parse_urdf(robot('<link name="base"/>', joint("stand", "base", "world", "fixed", "")))
