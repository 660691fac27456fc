"""Broken and malicious MJCF files: one error each, nothing printed, nothing opened outside of the folder."""

from __future__ import annotations

import os
import re
import sys

import pytest
from mujoco_oracle import model_of, mujoco
from test_mjcf_kinematics import GEOM, body, mjcf

import kineverse as kv
from kineverse.formats.mjcf import parse_mjcf, read_mjcf
from kineverse.formats.reader_warnings import Fault

WORLD = f"<worldbody>{body('a', '<joint/>')}</worldbody>"


@pytest.fixture(autouse=True)
def _quiet(tmp_path, monkeypatch, capfd):
    """Check that MuJoCo neither prints nor leaves a log in the current folder."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    yield
    assert mujoco.get_mju_user_warning() is None
    mujoco.set_mju_user_warning(before)
    assert list(here.iterdir()) == []
    assert capfd.readouterr() == ("", "")


_OPENED: list[str] = []


def _watch(event: str, args: tuple) -> None:
    if event == "open" and len(_OPENED) < 10_000:
        _OPENED.append(str(args[0]))


@pytest.fixture(scope="module", autouse=True)
def _watched():
    sys.addaudithook(_watch)  # once, for it cannot be taken back


def outcome(text: str | bytes, folder: object = "") -> str:
    with pytest.raises(kv.errors.FormatError) as info:
        model_of(parse_mjcf(text, "x.xml", str(folder)))
    return str(info.value)


@pytest.mark.parametrize(
    ("text", "place", "reason"),
    [
        ("", "x.xml, line 1", "no element found"),
        ("<mujoco>", "x.xml, line 1", "cut off"),
        ("<mujocoinclude/>", "x.xml, line 1, <mujocoinclude>", "a part that other files include"),
        ("<robot name='r'/>", "x.xml, line 1, <robot", "This is a URDF"),
        ("<!DOCTYPE m [<!ENTITY a 'b'>]><mujoco/>", "x.xml, line 1, <!DOCTYPE m>", "refused"),
        ("<mujoco>\n<link/></mujoco>", "x.xml, line 2, <link>", "unrecognized element"),
        (mjcf('<worldbody>\n<body name="b" colour="red"/></worldbody>'), 'line 3, <body name="b">', "unrecognized attribute: 'colour'"),
        (mjcf('<worldbody><body pos="0 nan 0"/></worldbody>'), "line 2, <body>", "NaN"),
        (mjcf('<worldbody><body pos="0 1e999 0"/></worldbody>'), "line 2, <body>", "too large"),
        (mjcf('<worldbody><body pos="0 x 0"/></worldbody>'), "line 2, <body>", "attribute 'pos'"),
        (mjcf('<worldbody><body pos="0 1"/></worldbody>'), "line 2, <body>", "not have enough data"),
        (mjcf('<worldbody><body name="m"><joint/></body></worldbody>'), 'line 2, <body name="m">', "mass and inertia of moving bodies"),
        (mjcf('<worldbody><body><joint name="j" axis="0 0 0"/><geom size="1"/></body></worldbody>'), 'line 2, <joint name="j">', "axis too small"),
        (mjcf('<worldbody><body name="a"/>\n<body name="a"/></worldbody>'), 'line 3, <body name="a">', "repeated name"),
        (mjcf(WORLD, '<equality><joint joint1="no"/></equality>'), "line 3, <joint>", "unknown element 'no'"),
        (mjcf('<worldbody><geom type="mesh" mesh="no"/></worldbody>'), "line 2, <geom>", "'no' not found"),
        (mjcf('<worldbody><replicate count="1000"><replicate count="1000"><body/></replicate></replicate></worldbody>'), "line 2, <", "larger than 30000 elements"),
        (mjcf('<worldbody><replicate count="1e300"><body/></replicate></worldbody>'), "line 2, <replicate>", "larger than 30000 elements"),
        (mjcf('<worldbody><replicate count="many"><body/></replicate></worldbody>'), "line 2, <replicate>", "is no number"),
        (mjcf("<worldbody>" + "<body>" * 460 + "</body>" * 460 + "</worldbody>"), "x.xml, line 2, <body>", "nested more than 450 deep"),
    ],
)  # fmt: skip
def test_invalid_mjcf_is_refused_with_a_reason(text, place, reason):
    message = outcome(text)
    assert place in message
    assert reason in message
    assert message.startswith("x.xml, ")
    assert "\n" not in message


def write(folder, name: str, text: str) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../secret.xml",
        "../../secret.xml",
        "sub/../../secret.xml",
        "link.xml",
        "there/secret.xml",
        "no.xml",
        "",
        "sub",
        "http://x.org/a.xml",
    ],
)
@pytest.mark.parametrize("element", ['<include file="{}"/>', '<asset><model name="m" file="{}"/></asset>'])
def test_files_outside_of_the_folder_are_not_opened(tmp_path, name, element):
    top = tmp_path / "robot"
    write(tmp_path, "secret.xml", "<mujoco><worldbody><body name='secret'/></worldbody></mujoco>")
    (top / "sub").mkdir(parents=True)
    (top / "link.xml").symlink_to(tmp_path / "secret.xml")
    (top / "there").symlink_to(tmp_path)
    _OPENED.clear()
    message = outcome(mjcf(element.format(name)), top)
    opened = [path for path in _OPENED if "secret" in path or "passwd" in path]
    assert message.startswith("x.xml, line 2, <")
    assert any(reason in message for reason in ("leads out of the root", "no such file", "names no file"))
    assert opened == []


NAMES = [
    (mjcf('<worldbody><body name="a"/>\n<body name="/a"/></worldbody>'), 'would be called "a" here', {"a", "a_2"}),
    (mjcf('<worldbody><body name="//"/></worldbody>'), "nothing but slashes", {"nameless"}),
    (mjcf('<worldbody><body name="a&#9;b"/></worldbody>'), "a control character", {"a_b"}),
    (
        mjcf("<worldbody>" + body("a", '<joint name="j" type="ball"/>') + body("b", '<joint name="j/qx"/>') + "</worldbody>"),
        'would be called "j/qx" here',
        {"a", "b"},
    ),
]  # fmt: skip


@pytest.mark.parametrize(("text", "problem", "names"), NAMES)
def test_names_that_cannot_be_names_are_replaced(text, problem, names):
    scene = parse_mjcf(text, "x.xml")
    (remark,) = scene.remarks
    assert isinstance(remark, Fault)
    assert problem in remark
    assert {link.name for link in scene.links} == {"world", *names}
    assert names <= set(model_of(scene).frames)
    with pytest.raises(kv.errors.FormatError, match=re.escape(problem)):
        parse_mjcf(text, "x.xml", strict=True)


def test_comments_and_declarations_that_xml_forbids_are_read():
    text = f'\n<?xml version="1.0"?><!-- a -- b -->{mjcf(WORLD)}'
    scene = parse_mjcf(text, "x.xml")
    assert len(scene.links) == 2
    assert sum(isinstance(remark, Fault) for remark in scene.remarks) == 2
    with pytest.raises(kv.errors.FormatError, match="not well-formed"):
        parse_mjcf(text, "x.xml", strict=True)


def test_nested_includes_are_found_from_both_folders(tmp_path):
    top = tmp_path / "robot"
    write(
        top,
        "sub/a.xml",
        '<mujocoinclude><body name="a"/><include file="b.xml"/><include file="sub/c.xml"/></mujocoinclude>',
    )
    write(top, "sub/b.xml", '<mujocoinclude><body name="b"/></mujocoinclude>')
    write(top, "sub/c.xml", '<mujocoinclude><body name="c">\n<body name="d" no=""/></body></mujocoinclude>')
    text = mjcf('<worldbody><include file="../robot/sub/a.xml"/></worldbody>')
    assert outcome(text, top).startswith('c.xml, line 2, <body name="d">: MuJoCo refuses it: ')
    write(top, "sub/c.xml", '<mujocoinclude><body name="c"/></mujocoinclude>')
    assert [link.name for link in parse_mjcf(text, "x.xml", str(top)).links] == ["world", "a", "b", "c"]


def test_second_include_of_a_file_is_refused(tmp_path):
    write(tmp_path, "a.xml", '<mujocoinclude>\n<include file="a.xml"/></mujocoinclude>')
    assert outcome(mjcf('<include file="a.xml"/>'), tmp_path).startswith(
        "a.xml, line 2, <include>: is there a second time"
    )
    assert "there a second time" in outcome(
        mjcf('<include file="a.xml"/><include file="./a.xml"/>'), tmp_path
    )


CHILD = '<mujoco model="c"><asset><mesh name="q" file="q.obj"/></asset><worldbody><body name="arm">\n<joint name="j"/>{}<geom type="mesh" mesh="q"/></body></worldbody></mujoco>'
PARENT = mjcf(
    '<asset><model name="m" file="sub/child.xml"/></asset>',
    '<worldbody><body name="b"><attach model="m" body="arm" prefix="{}"/></body>{}</worldbody>',
)


def test_attached_models_are_read_with_prefix(tmp_path):
    write(tmp_path, "sub/child.xml", CHILD.format(""))
    scene = parse_mjcf(
        PARENT.format(
            "left_", '<body name="c" pos="0 0 1"><attach model="m" body="arm" prefix="right_"/></body>'
        ),
        "x.xml",
        str(tmp_path),
    )
    assert [link.name for link in scene.links] == ["world", "b", "left_arm", "c", "right_arm"]
    assert scene.links[2].body.visuals[0].geometry.uri == "sub/q.obj"
    assert scene.remarks[0].startswith('child.xml, line 1, <mesh name="q"> is not read')
    write(tmp_path, "sub/child.xml", CHILD.format('<geom name="g" size="-1"/>'))
    assert outcome(PARENT.format("p_", ""), tmp_path).startswith(
        'child.xml, line 2, <geom name="g">: MuJoCo refuses it: '
    )
    write(tmp_path, "sub/child.xml", CHILD.format('<site no="1"/>'))
    assert outcome(PARENT.format("p_", ""), tmp_path).startswith(
        "child.xml, line 2, <site>: MuJoCo refuses it: "
    )


def test_recursive_and_too_large_attachments_are_refused(tmp_path):
    write(tmp_path, "sub/child.xml", '<mujoco>\n<asset><model name="m" file="child.xml"/></asset></mujoco>')
    assert outcome(PARENT.format("p_", ""), tmp_path).startswith(
        'child.xml, line 2, <model name="m">: attaches itself'
    )
    twice = '<attach model="m" body="b" prefix="{}_"/>'
    for k in range(18):
        write(
            tmp_path,
            f"{k}.xml",
            mjcf(
                f'<asset><model name="m" file="{k + 1}.xml"/></asset><worldbody><body name="b">{twice.format("l")}{twice.format("r")}</body></worldbody>'
            ),
        )
    write(tmp_path, "18.xml", mjcf('<worldbody><body name="b"/></worldbody>'))
    assert "makes the model larger than 30000 elements" in outcome((tmp_path / "0.xml").read_text(), tmp_path)


def test_no_plugin_no_texture_and_no_skin_is_loaded(tmp_path):
    text = mjcf(
        '<extension><plugin plugin="mujoco.sdf.nut"><instance name="nut"/></plugin></extension>',
        '<asset><texture name="t" type="cube" file="/etc/passwd"/><material name="m" texture="t"/><skin name="s" file="/etc/passwd"/></asset>',
        '<worldbody><light texture="t"/><camera/><body name="a"><joint name="j"/><plugin plugin="mujoco.elasticity.cable"/><geom size="1" material="m"/>'
        '<flexcomp name="f" type="mesh" file="/etc/passwd"/></body></worldbody>',
        '<sensor><jointpos joint="no"/></sensor><contact><exclude body1="no" body2="a"/></contact><size memory="1T"/>',
        '<deformable><skin file="/etc/passwd"/></deformable><actuator><plugin plugin="mujoco.pid" joint="j"/></actuator>',
    )
    scene = parse_mjcf(text, "x.xml", str(tmp_path))
    assert [link.name for link in scene.links] == ["world", "a"]
    assert [remark.partition(" is left out: ")[2] for remark in scene.remarks] == [
        "which pairs are allowed to touch is not read.",
        "what bends has no frames here.",
        "plugins are not loaded.",
        "what bends has no frames here.",
        "plugins are not loaded.",
    ]


def test_names_and_numbers_reach_mujoco_unchanged():
    name = "a <&> \"é\" 'x'"
    escaped = name.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    text = f'<?xml version="1.0" encoding="iso-8859-1"?><mujoco><worldbody><body name="{escaped}">{GEOM}<!-- <body/> --></body></worldbody></mujoco>'
    assert [link.name for link in parse_mjcf(text.encode("latin-1")).links] == ["world", name]
    assert f"p/{name}" in model_of(parse_mjcf(text.encode("latin-1")), "p").frames


def test_truncated_files_are_format_errors(published):
    whole = published("articulated_objects/robosuite_mit/objects/door.xml").read_bytes()
    for length in range(0, len(whole.rstrip()), 41):
        assert outcome(whole[:length]).startswith("x.xml, line ")


def test_missing_file_is_an_error(tmp_path):
    with pytest.raises(kv.errors.FormatError, match="there is no such file"):
        read_mjcf(tmp_path / "no.xml")


def test_without_mujoco_the_error_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    write(tmp_path, "x.xml", mjcf(WORLD))
    with pytest.raises(kv.errors.MissingDependencyError, match=r"pip install -e '.*\[mjcf\]'"):
        kv.load(tmp_path / "x.xml")


def test_root_element_decides_the_format_of_xml(tmp_path):
    write(tmp_path, "m.xml", f"<?xml version='1.0'?>\n<!-- <robot> -->\n{mjcf(WORLD)}")
    write(tmp_path, "u.xml", '<!-- <mujoco> --><robot name="r"><link name="l"/></robot>')
    assert list(kv.load(tmp_path / "m.xml", prefix="p").frames) == ["p/world", "p/a"]
    assert list(kv.load(tmp_path / "u.xml").frames) == ["l"]
    (tmp_path / "m.mjcf").write_bytes(mjcf(WORLD).encode("utf-16"))
    assert list(kv.load(tmp_path / "m.mjcf").frames) == ["a"]
    (tmp_path / "w.xml").write_bytes(mjcf(WORLD).encode("utf-16"))
    assert list(kv.load(tmp_path / "w.xml").frames) == ["a"]


def test_changed_includes_are_read_again(tmp_path):
    write(tmp_path, "x.xml", mjcf('<worldbody><include file="part.xml"/></worldbody>'))
    for name in ("one", "two"):
        write(tmp_path, "part.xml", f'<mujocoinclude><body name="{name}"/></mujocoinclude>')
        assert list(kv.load(tmp_path / "x.xml").frames) == [name]


def test_mujoco_warnings_become_reader_warnings():
    joints = '<joint axis="1 0 0"/><joint axis="1 0 0"/>'
    scene = parse_mjcf(mjcf(f"<worldbody>{body('a', joints)}</worldbody>", '<statistic meanmass="1"/>'))
    assert all(remark.startswith("MuJoCo says: ") for remark in scene.remarks)
    assert len(scene.links[1].joints) == 2
    assert os.listdir() == []
