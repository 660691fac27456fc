"""Templates of xacro: what they expand to, their arguments and packages, and what they may not do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import FormatError, InvalidValueError, MissingDependencyError
from kineverse.formats import isolation
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.xacro import check_expression

XMLNS = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
LEG = f"""<robot {XMLNS}>
<xacro:property name="size" value="0.3"/>
<xacro:macro name="leg" params="name parent *origin">
  <link name="${{name}}_leg"/>
  <joint name="${{name}}" type="revolute">
    <xacro:insert_block name="origin"/>
    <parent link="${{parent}}"/> <child link="${{name}}_leg"/>
    <limit lower="0" upper="${{pi/2}}" effort="${{missing}}" velocity="1"/>
  </joint>
</xacro:macro></robot>""".replace("${missing}", "${strength}")


@pytest.fixture
def write(tmp_path: Path):
    """Return a function that writes a template beside the file of its macros, and returns its path."""
    folder = tmp_path / "robot" / "urdf"
    folder.mkdir(parents=True)
    (folder / "leg.xacro").write_text(LEG)

    def template(*lines: str, name: str = "r.urdf.xacro", root: str = "robot", before: str = "") -> Path:
        include = '<xacro:include filename="leg.xacro"/>' if root == "robot" else ""
        text = [f'<{root} name="r" {XMLNS}{before}>', include, *lines, f"</{root}>"]
        (folder / name).write_text("\n".join(text))
        return folder / name

    return template


@pytest.fixture
def needs_xacro() -> None:
    pytest.importorskip("xacro")


STRONG = '<xacro:property name="strength" value="${2 * size}"/>'
SIDE = '<xacro:arg name="side" default="left"/>'
ONE_LEG = '<link name="base"/><xacro:leg name="$(arg side)" parent="base"><origin xyz="${size + 1} 0 0"/></xacro:leg>'


@pytest.mark.usefixtures("needs_xacro")
def test_a_template_is_the_robot_that_it_expands_to(write):
    path = write(STRONG, SIDE, ONE_LEG)
    model = kv.load(path)
    assert set(model.frames) == {"base", "left_leg"}
    assert model.limits("left") == (0, np.pi / 2)
    assert dict(model.articulations["left"].dynamics) == {"effort": 0.6}
    np.testing.assert_allclose(model.fk("left_leg")({"left": 0.0})[0, 3], 1.3)
    (right,) = kv.load(path, arguments={"side": "right"}, prefix="r").degrees_of_freedom
    (other,) = kv.load(f"{path} side:=other").degrees_of_freedom
    assert (str(right), str(other)) == ("r/right", "other")


@pytest.mark.usefixtures("needs_xacro")
def test_packages_are_found_as_those_of_meshes(write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "elsewhere" / "parts"
    package.mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>parts</name></package>")
    (package / "more.xacro").write_text(f'<robot {XMLNS}><link name="more"/></robot>')
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "elsewhere"))
    mesh = '<link name="l"><visual><geometry><mesh filename="file://$(find r_description)/meshes/a.stl"/></geometry></visual></link>'
    meshes = tmp_path / "robot" / "meshes"
    meshes.mkdir()
    (meshes / "a.stl").touch()
    lines = [
        '<xacro:include filename="$(find parts)/more.xacro"/>',
        '<xacro:include filename="$(find r_description)/urdf/leg.xacro"/>',
        mesh,
    ]
    with collect_warnings() as said:
        model = kv.load(write(*lines))
    assert {"more", "l"} <= set(model.frames)
    assert any(
        f'there is no package "r_description"; {tmp_path / "robot"} is taken for it' in text for text in said
    )
    assert kv.formats.resource_paths.locate_mesh(model.bodies["l"].visuals[0].geometry).samefile(
        meshes / "a.stl"
    )


@pytest.mark.usefixtures("needs_xacro")
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('<xacro:leg name="a" parent="base"><origin/></xacro:leg>', r"leg.xacro, line 8, <limit>: name 'strength' is not defined"),
        ('<xacro:leg name="a"/>', "r.urdf.xacro, line 3, <xacro:leg>: "),
        ('<xacro:include filename="../../../secret.xacro"/>', r"line 3, <xacro:include>: .* leads out of the root"),
        ("<link name=\"${load_yaml('/etc/hostname')}\"/>", "line 3, <link>: .*leads out of the root"),
        ('<link name="${[x.__class__ for x in [1]]}"/>', "line 3, <link>: the name '__class__' is not allowed"),
        ('<link name="$(eval open)"/>', "line 3, <link>: .*name 'open' is not defined"),
        ('<xacro:include filename="r.urdf.xacro"/>', "nest too deeply, or without end"),
        ("<link>", "r.urdf.xacro.*: mismatched tag"),
        ('<link name="$(arg hand)"/>', 'line 3, <link>: it needs the argument "hand", .*: hand:=VALUE'),
        ("<link name=\"${'a' * 10**11}\"/>", "line 3, <link>: it takes more than 4 GiB of memory"),
    ],
    ids=["name", "parameters", "outside", "yaml", "class", "open", "circle", "XML", "argument", "memory"],
)  # fmt: skip
@pytest.mark.sampled(3)
def test_errors_of_a_template_name_file_line_and_element(write, line: str, message: str):
    with pytest.raises(FormatError, match=message):
        kv.load(write(line))


@pytest.mark.usefixtures("needs_xacro")
def test_arguments_that_a_template_does_not_have_are_refused(write, tmp_path: Path):
    with pytest.raises(FormatError, match=r'it has no argument "sied"\. Its arguments: side\.'):
        kv.load(
            write(STRONG, SIDE, ONE_LEG, '<link name="$(eval side + side)"/>'), arguments={"sied": "left"}
        )
    (tmp_path / "r.urdf").write_text('<robot name="r"><link name="l"/></robot>')
    with pytest.raises(InvalidValueError, match="takes no arguments such as side"):
        kv.load(tmp_path / "r.urdf", arguments={"side": "left"})


@pytest.mark.usefixtures("needs_xacro")
def test_a_template_may_use_arguments_undeclared_and_include_what_is_not_there(write):
    lines = [
        '<xacro:include filename="other/none.xacro" optional="true"/>',
        '<xacro:include filename="leg.xacro"/>',
        '<link name="$(arg side)"/>',
    ]
    assert list(kv.load(write(*lines), arguments={"side": "left"}).frames) == ["left"]


@pytest.mark.usefixtures("needs_xacro")
def test_links_of_an_installed_workspace_lead_to_its_sources(
    write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    lines = [
        '<xacro:include filename="$(find r_description)/urdf/leg.xacro"/>',
        '<xacro:include filename="more.xacro"/>',
    ]
    source = write(*lines)
    (source.parent / "more.xacro").write_text(f'<robot {XMLNS}><link name="more"/></robot>')
    installed = tmp_path / "install" / "share" / "r_description"
    (installed / "urdf").mkdir(parents=True)
    (installed / "package.xml").write_text("<package><name>r_description</name></package>")
    for file in source.parent.iterdir():
        (installed / "urdf" / file.name).symlink_to(file)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    assert list(kv.load(installed / "urdf" / source.name).frames) == ["more"]
    other = tmp_path / "mine" / "other.urdf.xacro"
    other.parent.mkdir()
    other.write_text(
        f'<robot {XMLNS}><xacro:include filename="$(find r_description)/urdf/more.xacro"/></robot>'
    )
    assert list(kv.load(other).frames) == ["more"]


@pytest.mark.usefixtures("needs_xacro")
def test_what_is_taken_for_a_package_opens_no_further_files(write, tmp_path: Path):
    (tmp_path / "robot" / "secret.xacro").write_text(f'<robot {XMLNS}><link name="secret"/></robot>')
    lines = [f'<xacro:include filename="$(find x)/{path}"/>' for path in ("urdf/leg.xacro", "secret.xacro")]
    with pytest.raises(FormatError, match=r"line 4, <xacro:include>: .*leads out of the root"):
        kv.load(write(*lines))


@pytest.mark.usefixtures("needs_xacro")
def test_a_template_has_the_encoding_that_it_declares(write):
    path = write(SIDE, '<link name="tür"/>')
    path.write_bytes(f'<?xml version="1.0" encoding="iso-8859-1"?>{path.read_text()}'.encode("iso-8859-1"))
    assert list(kv.load(path).frames) == ["tür"]


@pytest.mark.usefixtures("needs_xacro")
def test_templates_of_sdf_are_read(write):
    model = kv.load(
        write(
            '<model name="m"><link name="${1 + 1}"/></model>',
            name="m.sdf.xacro",
            root="sdf",
            before=' version="1.9"',
        )
    )
    assert list(model.frames) == ["2"]


@pytest.mark.usefixtures("needs_xacro")
def test_work_without_end_is_stopped(write, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        isolation, "_CHILD", f"import kineverse.formats.isolation as i; i.CPU_SECONDS = 1; {isolation._CHILD}"
    )
    bombs = [f'<xacro:macro name="m{k}"><xacro:m{k + 1}/><xacro:m{k + 1}/></xacro:macro>' for k in range(40)]
    with pytest.raises(FormatError, match=r"r.urdf.xacro: xacro does not expand it: its process ended with"):
        kv.load(write(*bombs, '<xacro:macro name="m40"/><xacro:m0/>'))


def test_without_xacro_the_extra_is_named(write, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"r.urdf.xacro is a template of xacro.*\[xacro\]"):
        kv.load(write(SIDE))


@pytest.mark.parametrize(
    "text",
    ["1 + 2 * x", "-x ** 2", "a if b else c", "x[0]['k']", "[i * 2 for i in range(3)]", "{'a': 1}", "f'{x}_link'",
     "math.sin(pi / 2)", "', '.join(names)", "config.joints.first", "'%s' % x", "not a and b or c", " x ", "_x + 1",
     "joint.f_max + joint.co_axial"],
)  # fmt: skip
def test_expressions_of_arithmetic_texts_and_data_are_allowed(text: str):
    check_expression(text, ValueError)


@pytest.mark.parametrize(
    "text",
    ["().__class__", "x._y", "(lambda: 1)()", "[(lambda: i) for i in x]", "(y := 1)", "'{0.x}'.format(1)", "__import__('os')",
     "int.mro()", "(i for i in x).gi_frame", "f.f_globals", "x.tb_frame", "f.func.co_consts", "f'{x.__class__}'",
     "(i for i in (x.__class__,))", "a[b.__c__]", "f(**{'a': b.__c__})", "f'{x:{y.__c__}}'"],
)  # fmt: skip
def test_expressions_that_lead_to_python_itself_are_refused(text: str):
    with pytest.raises(ValueError, match="not allowed in an expression"):
        check_expression(text, ValueError)
