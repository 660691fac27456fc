"""Inputs found by fuzzing, minimised by hand: each gives a model, or one error with the reason."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_sdf_joints import Z, mimic
from test_sdf_joints import joint as sdf_joint
from test_sdf_pose_graph import link, pose, sdf
from urdf_texts import joint, pair, robot

import kineverse as kv
from kineverse.errors import suggest
from kineverse.formats.document import read_operations, to_json
from kineverse.formats.resource_paths import locate_resource
from kineverse.formats.xml_reader import abbreviate, quote

INVISIBLE = "\U000e0001"
"""A character of ten in the escaped form that messages show."""


def loaded(tmp_path, text: str, name: str = "input.urdf", strict: bool = True) -> kv.Model | str:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    try:
        return kv.load(path, strict=strict)
    except kv.errors.FormatError as error:
        return str(error)


def limited(lower: str, upper: str) -> str:
    return f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'


def follower(factors: str, kind: str) -> str:
    leader = joint("j", "l0", "l1", kind, limited("-1", "1"))
    return robot(
        leader, joint("k", "l1", "l2", kind, limited("1", "2") + f'<mimic joint="j" {factors}/>'), links=3
    )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        # Two offsets of this size were an infinite one.
        (
            robot(
                joint("a", "l0", "l1", "fixed", '<origin xyz="1e308 0 0"/>'),
                joint("b", "l1", "l2", "fixed", '<origin xyz="1e308 0 0"/>'),
                links=3,
            ),
            "has a number beyond 1e+50",
        ),
        # Two such sliders in a row were infinitely far away.
        (pair(limited("1e308", "1.7e308"), "prismatic"), "all positions would be beyond 1e+50"),
        (pair(limited("-1.7e308", "-1e308"), "prismatic"), "all positions would be beyond 1e+50"),
        # To reach its limits, the follower needed its leader at infinity.
        (follower('multiplier="5e-324"', "prismatic"), "positions or limits overflow"),
        (follower('multiplier="1e200" offset="1e200"', "revolute"), "positions or limits overflow"),
    ],
)
def test_urdf_numbers_that_overflow_are_refused(tmp_path, text, reason):
    message = loaded(tmp_path, text)
    assert isinstance(message, str)
    assert message.startswith("input.urdf, line ")
    assert reason in message
    model = loaded(tmp_path, text, strict=False)
    if "has a number" in reason:
        assert isinstance(model, str)
    else:
        assert_finite(model)


@pytest.mark.parametrize(
    "text",
    [
        # The length of the axis was infinite, and its direction (0, 0, 0).
        pair(limited("0", "1") + '<axis xyz="1.7e308 1.7e308 1.7e308"/>'),
        pair(limited("0", "1") + '<origin rpy="1e99 -1.7e308 1e60"/>'),
        robot(
            joint("a", "l0", "l1", "fixed", '<origin quat_xyzw="1e308 1e308 1e308 1e308"/>'),
            links=2,
            attributes='name="r" version="1.1"',
        ),
    ],
)
def test_large_numbers_in_directions_are_read(tmp_path, text):
    assert_finite(loaded(tmp_path, text))


def assert_finite(model) -> None:
    state = model.default_state()
    assert all(np.isfinite(model.fk(name)(state)).all() for name in model.frames)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            sdf(
                link("a"),
                link("b", pose("1e308 0 0 0 0 0")),
                '<frame name="f" attached_to="b"><pose>1e308 0 0 0 0 0</pose></frame>',
            ),
            "has a number beyond 1e+50",
        ),
        (sdf(link("a", pose("0 0 0 0 0 1e300"))), "has a number beyond 1e+50"),
        (
            sdf(
                link("a"),
                link("b"),
                sdf_joint("j", "screw", "a", "b", Z + "<screw_thread_pitch>1e300</screw_thread_pitch>"),
            ),
            "has a thread without pitch, or with too much",
        ),
        (
            sdf(
                link("a"),
                link("b"),
                link("c"),
                sdf_joint("j", "revolute", "a", "b", Z),
                sdf_joint(
                    "k", "revolute", "b", "c", Z.replace("</axis>", mimic("j", 1e200, reference=1e200))
                ),
            ),
            "positions or limits overflow",
        ),
    ],
)
def test_sdf_numbers_that_overflow_are_refused(tmp_path, text, reason):
    message = loaded(tmp_path, text, "input.sdf")
    assert isinstance(message, str)
    assert message.startswith("input.sdf, line ")
    assert reason in message


def test_largest_double_is_no_limit(tmp_path):
    """Exporters write it for no limit."""
    model = loaded(tmp_path, pair(limited("-1.7976931348623157e308", "1.7976931348623157e308")))
    assert isinstance(model, kv.Model)
    assert np.isfinite(model.fk("l1")(model.default_state())).all()


def test_pose_with_too_large_numbers_is_refused():
    with pytest.raises(kv.errors.InvalidValueError, match=r"all numbers finite, of at most 1e\+100"):
        kv.model.Pose.from_matrix(kv.translation(1e200, 0, 0))


@pytest.mark.parametrize("name", ["y" * 3000, INVISIBLE * 400, "é" * 100 + "\x85" * 100])
@pytest.mark.parametrize("places", [("child",), ("link", "link"), ("joint", "joint"), ("mimic",), ("value",)])
def test_messages_have_bounded_length(tmp_path, name, places):
    parts = {
        "child": joint("j", "l0", "nobody", "fixed") + f'<link name="{name}"/>',
        "link": f'<link name="{name}"/>',
        "joint": joint(name, "l0", "l1", "fixed"),
        "mimic": joint("j", "l0", "l1", "continuous", f'<mimic joint="z{name}"/>') + joint(name, "l1", "l2"),
        "value": f'<link name="a"><inertial><mass value="{name}"/></inertial></link>',
    }
    message = loaded(tmp_path, robot(*(parts[place] for place in places), links=3))
    assert isinstance(message, str)
    assert len(message) < 2000


def document(nodes: list, *writes: dict) -> bytes:
    operations = [
        {"tag": f"t{i}", "kind": "K", "nodes": nodes, "writes": write}
        for i, write in enumerate(writes or [{}])
    ]
    return json.dumps({"format": "kineverse", "version": 2, "operations": operations}).encode()


def built(data: bytes | str) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for tag, operation in read_operations(data):
            edit.apply(operation, tag)
    return model


def test_document_parameter_that_is_no_pose_is_refused():
    tree = json.loads(document([], {}))
    tree["operations"][0]["parameters"] = {"at": {"pose": [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}}
    with pytest.raises(
        kv.errors.FormatError, match=r"^document, operations\[0\] \('t0'\), parameters: The pose is"
    ):
        read_operations(json.dumps(tree))


@pytest.mark.parametrize("question", [[], ["datum"]])
def test_document_condition_without_operands_is_refused(question):
    tree = json.loads(document([], {}))
    tree["operations"][0]["trace"] = {"questions": [question], "writes": {}}
    with pytest.raises(kv.errors.FormatError, match="a question is its kind, how closely"):
        read_operations(json.dumps(tree))


def test_reasons_have_bounded_length_for_long_symbol_names():
    nodes = [
        ["symbol", "y" * 3000, 0, "dof"],
        ["symbol", "a", 0, "dof"],
        ["symbol", "b", 0, "dof"],
        ["matrix", [1], [0]],
        ["implicit", "i", [1], [2], 3, [0], 3, 5, [2], []],
    ]
    with pytest.raises(kv.errors.FormatError, match=r"nodes\[4\]: 'i': the residual is about y") as info:
        read_operations(document(nodes))
    assert len(str(info.value)) < 1200


def test_a_frame_without_factors_is_where_its_parent_is():
    """It could be written, and not loaded."""
    model = built(document([], {"frames": {"f": {"parent": "world", "factors": []}}}))
    assert (model.fk("f")() == np.eye(4)).all()
    text = to_json(model)
    assert to_json(built(text)) == text


@pytest.mark.parametrize(
    "rows",
    [
        [[0, []], [1, [[4, 9]]]],  # a zero, which is left out when it is written
        [
            [0, [[7, 10]]],
            [1, [[4, 10], [6, 10]]],
        ],  # a row by way of another, and another order of speeds by that
    ],
)
def test_rate_tables_are_read_back_unchanged(rows):
    """The digest of the node was another one, and so was the order of nodes in the next document."""
    nodes = [
        *(["symbol", name, order, "dof"] for order in (0, 1) for name in "abcd"),
        ["matrix", [3], [0, 0, 0]],
        ["constant", 0],
        ["constant", 1],
        ["norm", 8],
        ["carried", 1, rows],
        [
            "matrix",
            [4, 4],
            [12, None, None, 11, None, 12, None, None, None, None, 12, None, 10, None, None, 10],
        ],
    ]
    text = to_json(built(document(nodes, {"frames": {"h": {"parent": "world", "factors": [13]}}})))
    assert to_json(built(text)) == text


def test_carried_coordinate_unchanged_by_composition_is_plain():
    """It was plain only after a document was written twice."""
    nodes = [
        ["symbol", "b", 0, "dof"],
        ["symbol", "a", 0, "dof"],
        ["symbol", "a", 2, "dof"],
        ["carried", 0, [[0, []]]],
        ["dependent", 1, 0],
        ["composed", 3, [[2, 4]]],
    ]
    model = built(document(nodes, {"constraints": {"c": [5, 1, 1]}}))
    assert model.constraints["c"].lower == kv.position("b")
    text = to_json(model)
    assert to_json(built(text)) == text


def test_loop_without_solution_is_named_where_its_input_cancels():
    """The Jacobian is NaN whatever b is, and so did not ask for b; looking for the reason did."""
    nodes = [
        ["symbol", "a", 0, "dof"],
        ["symbol", "b", 0, "dof"],
        ["symbol", "b", 2, "dof"],
        ["constant", 5],
        ["matrix", [1], [3]],
        ["matrix", [1], [0]],
        ["implicit", "i", [1], [0], 4, [0], 5, 5, [2], []],
        ["element", 6, 0],
        ["symbol", "a", 1, "dof"],
        ["matrix", [4, 4], [2, 0, 0, 0, None, 7, 8, 0, 0, 0, None, 0, 0, 0, 0, 0]],
    ]
    model = built(document(nodes, {"frames": {"h": {"parent": "world", "factors": [9]}}}))
    with pytest.raises(kv.errors.NoSolutionError, match="'i' has no solution at a = 0"):
        model.jacobian("h")(model.default_state())


@pytest.mark.parametrize("depth", [33, 65])
def test_data_nested_deeper_than_arrays_can_be_overwritten_by_an_expression(depth):
    deep = 1
    for _ in range(depth):
        deep = [deep]
    model = built(
        document([["symbol", "a", 0, "dof"]], {"data": {"x": deep}}, {"data": {"x": {"expression": 0}}})
    )
    assert model.data["x"] == kv.position("a")
    with pytest.raises(kv.errors.ShapeError, match="nested more than 32 deep"):
        kv.array(deep)


@pytest.mark.parametrize("text", ["x" * 500, INVISIBLE * 500, INVISIBLE * 79, "x" * 79 + INVISIBLE, "\n"])
def test_quoted_text_is_printable_and_bounded(text):
    assert len(abbreviate(text)) <= 80
    assert abbreviate(text).isprintable()
    assert quote(text) == f'"{abbreviate(text)}"'


def test_suggestions_have_bounded_length():
    names = [f"{i}{INVISIBLE * 3000}" for i in range(20)]
    assert len(suggest("a", names)) < 1500
    assert len(suggest(names[0][:-1], names)) < 1500
    assert suggest("cab", ["cap"]) == "Did you mean 'cap'?"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        # Its square is infinite inside of MuJoCo, and what was left of the rotation was zero.
        ('<body quat="1e308 2 0 0"/>', 'quat="1e308 2 0 0" has a number beyond 1e+50'),
        ('<body quat="0x1p900 2 0 0"/>', "has a number beyond 1e+50"),
        ('<body pos="1e150 0 0"/>', "has a number beyond 1e+50"),
        # The first position within the limits was so far away that the pose of the body was infinite.
        (
            '<body><joint type="slide" range="1e300 1e305"/><geom size="1"/></body>',
            "all of its numbers beyond",
        ),
        ('<body><joint range="-1e305 -1e300"/><geom size="1"/></body>', "all of its numbers beyond 1e+50"),
        ('<body pos="0 -Infinity 0"/>', "has a number beyond 1e+50"),
        ('<replicate count="2" offset="1e50 0 0"><body pos="1e50 0 0"/></replicate>', "too large (body_pos)"),
    ],
)
def test_mjcf_numbers_that_overflow_are_refused(tmp_path, text, reason):
    message = loaded(tmp_path, f"<mujoco><worldbody>{text}</worldbody></mujoco>", "input.xml")
    assert isinstance(message, str)
    assert message.startswith("input.xml")
    assert reason in message


def test_mjcf_model_without_file_is_refused(tmp_path):
    """MuJoCo raised an exception of an unknown type."""
    message = loaded(tmp_path, "<mujoco><asset><model/></asset></mujoco>", "input.xml")
    assert message == "input.xml, line 1, <model>: names no file."


def test_largest_double_is_no_range(tmp_path):
    joint = '<joint type="slide" range="-1.7e308 1.7e308"/>'
    text = f"<mujoco><worldbody><body name='a'>{joint}<geom size='1'/></body></worldbody></mujoco>"
    model = loaded(tmp_path, text, "input.xml")
    assert isinstance(model, kv.Model)
    assert (model.fk("a")(model.default_state()) == np.eye(4)).all()


def test_tendon_of_infinite_length_is_refused(tmp_path):
    """The difference to its length at rest was no number."""
    joint = '<body><joint name="{}"/><geom size="1"/></body>'
    text = (
        "<mujoco><worldbody>{}</worldbody><tendon><fixed name='t'><joint joint='{}' coef='{}'/></fixed></tendon>"
        "<equality><tendon tendon1='t'/></equality></mujoco>"
    )
    message = loaded(tmp_path, text.format(joint.format("j"), "j", "Infinity"), "input.xml")
    assert message == ('input.xml, line 1, <joint>: coef="Infinity" has a number beyond 1e+50.')
    model = loaded(tmp_path, text.format(joint.format("inf"), "inf", "1"), "input.xml")
    assert isinstance(model, kv.Model)
    assert [str(s) for s in model.degrees_of_freedom] == ["inf"]


def test_a_coordinate_that_depends_on_itself_in_a_gradient_only():
    """Carrying its rate did not terminate."""
    nodes = [
        ["symbol", "x", 0, "dof"],
        ["symbol", "y", 0, "dof"],
        ["symbol", "y", 1, "dof"],
        ["augment", 1, False, False, [[2, 0]]],
    ]
    with pytest.raises(kv.errors.ModelError, match="Coordinates that depend on themselves: x -> x"):
        built(document(nodes, {"rates": {"x": [0, 3]}}))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("input.sdf", '<sdf version="1.7"><include><uri>{}</uri></include></sdf>'),
        ("input.sdf", '<sdf version="1.7"><include><uri>model://{}/a.sdf</uri></include></sdf>'),
        ("input.xml", '<mujoco><worldbody><include file="{}"/></worldbody></mujoco>'),
        ("input.xml", '<mujoco><asset><model file="{}.xml"/></asset></mujoco>'),
    ],
)
def test_too_long_file_names_are_refused(tmp_path, name, text):
    message = loaded(tmp_path, text.format("9" * 300), name)
    assert isinstance(message, str)
    assert message.startswith(f"{name}, line 1, <")
    assert len(message) < 2000


def test_too_long_mesh_file_name_is_not_found(tmp_path):
    mesh = f'<asset><mesh name="m" file="{"9" * 300}.stl"/></asset>'
    body = '<worldbody><body name="b"><geom type="mesh" mesh="m"/></body></worldbody>'
    assert isinstance(loaded(tmp_path, f"<mujoco>{mesh}{body}</mujoco>", "input.xml"), kv.Model)
    with pytest.raises(kv.errors.FormatError, match="there is no such file"):
        locate_resource("9" * 300 + ".stl", tmp_path)
