"""Options ``--strict`` and ``--root`` of all commands."""

import json

import pytest

LIMITLESS = """<robot name="r"><link name="a"/><link name="b"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit lower="0" upper="1"/></joint></robot>"""
MISSING = "<limit> has no effort; the specification requires it"


@pytest.fixture
def loose(tmp_path):
    path = tmp_path / "loose.urdf"
    path.write_text(LIMITLESS)
    return path


def test_validate_lists_all_mistakes_and_fails(run, loose):
    status, out, err = run("validate", str(loose))
    assert (status, err) == (2, "")
    assert "not read strictly: 2 mistakes, no problems" in out
    assert MISSING in out
    assert "<limit> has no velocity" in out
    status, out, _ = run("validate", str(loose), "--json")
    (file,) = json.loads(out)["files"]
    assert (status, file["status"], len(file["mistakes"])) == (2, 2, 2)
    assert MISSING in file["error"]


@pytest.mark.parametrize("command", [("info",), ("fk", "b"), ("convert", "out.kv.json")])
def test_commands_tolerate_mistakes_unless_strict(run, loose, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, *rest = command
    assert run(name, str(loose), *rest)[0] == 0
    status, out, err = run(name, str(loose), *rest, "--strict", *(["--force"] if name == "convert" else []))
    assert (status, out) == (2, "")
    assert MISSING in err


def test_info_prints_remarks(run, loose):
    assert MISSING in run("info", str(loose))[1]
    assert any(MISSING in remark for remark in json.loads(run("info", str(loose), "--json")[1])["remarks"])


@pytest.mark.parametrize(
    "command", [("info",), ("fk", "b"), ("validate",), ("diff",), ("convert", "o.kv.json"), ("decompose",)]
)
def test_commands_that_load_models_have_a_root_option(run, tmp_path, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.xml").write_text(
        '<mujocoinclude><worldbody><body name="b"><geom size="1"/></body></worldbody></mujocoinclude>'
    )
    (tmp_path / "robot").mkdir()
    path = tmp_path / "robot" / "r.xml"
    path.write_text('<mujoco><include file="../part.xml"/></mujoco>')
    name, *rest = command
    words = [name, str(path), *([str(path)] if name == "diff" else rest)]
    status, out, err = run(*words)
    assert status == 2
    assert "leads out of the root" in out + err
    assert run(*words, "--root", str(tmp_path))[0] == 0
