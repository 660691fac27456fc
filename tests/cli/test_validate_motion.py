"""``kineverse validate --motion``: text, JSON, pictures and exit status."""

import json
from functools import partial

import numpy as np
import pytest
from PIL import Image

BROKEN = """<robot name="box"><link name="box"><collision><origin xyz="0 0 .2"/><geometry><box size=".4 .4 .4"/>
  </geometry></collision></link>
<link name="lid"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz=".2 0 .012"/><geometry><box size=".4 .4 .02"/></geometry></collision></link>
<joint name="lid" type="revolute"><parent link="box"/><child link="lid"/><origin xyz="-.2 0 .4"/>
  <axis xyz="0 {sign}1 0"/><limit lower="0" upper="{upper}" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture
def run(run):
    return partial(run, "validate")


@pytest.fixture
def lid(tmp_path):
    def write(sign="-", upper=1.5, inertia=False):
        text = BROKEN.format(sign=sign, upper=upper)
        if not inertia:
            text = text.replace('izz="1"', 'izz=".01"').replace('ixx=".1" iyy=".1"', 'ixx=".01" iyy=".01"')
        (tmp_path / "box.urdf").write_text(text)
        return str(tmp_path / "box.urdf")

    return write


def test_a_sound_model_has_status_0_and_says_so(run, lid):
    status, out, _ = run(lid(), "--motion")
    assert status == 0
    assert "motion of 1 coordinate: nothing wrong" in out


def test_a_finding_has_status_1_its_reason_first_and_what_to_do_after(run, lid):
    status, out, _ = run(lid(upper=90), "--motion")
    assert status == 1
    lines = out.splitlines()
    at = next(k for k, line in enumerate(lines) if "turns 14.3 times" in line)
    assert lines[at].startswith("    lid: ")
    assert "radians" in lines[at + 1]


def test_a_suspect_has_status_0_and_says_where_it_is_worst(run, lid):
    status, out, _ = run(lid(sign=""), "--motion")
    assert status == 0
    assert "enters 'box'" in out
    assert "the other way it is free" in out
    assert "at lid = 0.8125: 0.288 m, where 0.004 m is accepted" in out


def test_an_inertia_is_said_once_with_its_coordinate(run, lid):
    status, out, _ = run(lid(inertia=True), "--motion")
    assert status == 1
    assert out.count("exceeds the sum") == 1
    assert "lid: 'lid' has principal moments" in out
    assert run(lid(inertia=True))[1].count("exceeds the sum") == 1


def test_json_lists_coordinates_with_findings_and_suspects(run, lid):
    status, out, _ = run(lid(sign="", upper=1.5), "--motion", "--json")
    answer = json.loads(out)
    (coordinate,) = answer["coordinates"]
    assert (status, answer["status"], coordinate["name"], coordinate["ok"]) == (0, 0, "lid", True)
    assert coordinate["findings"] == []
    (suspect,) = coordinate["suspects"]
    assert (suspect["kind"], suspect["against"], suspect["unit"]) == ("flipped_axis", "box", "m")
    assert suspect["value"] > suspect["limit"] > 0
    status, out, _ = run(lid(upper=90), "--motion", "--json")
    answer = json.loads(out)
    assert (status, answer["status"], answer["files"][0]["status"]) == (1, 1, 1)
    assert [f["kind"] for f in answer["coordinates"][0]["findings"]] == ["degrees_for_radians"]
    assert "coordinates" not in json.loads(run(lid(), "--json")[1])


def test_crossed_limits_are_findings_of_a_file_with_mistakes(run, lid):
    status, out, _ = run(lid(upper=-1), "--motion", "--json")
    (coordinate,) = json.loads(out)["coordinates"]
    assert status == 2
    assert "crossed_limits" in [finding["kind"] for finding in coordinate["findings"]]


def test_several_files_are_told_apart(run, lid, tmp_path):
    other = tmp_path / "gone.urdf"
    status, out, _ = run(lid(upper=90), str(other), "kitchens/2", "--motion", "--json")
    answer = json.loads(out)
    assert status == 2
    assert {one["file"] for one in answer["coordinates"]} == {lid(upper=90), "kitchens/2"}
    status, out, _ = run(lid(upper=90), "kitchens/2", "--motion")
    assert status == 1
    assert "turns 14.3 times" in out
    twin = tmp_path / "twin" / "box.urdf"
    twin.parent.mkdir()
    twin.write_bytes((tmp_path / "box.urdf").read_bytes())
    pictures = ["--pictures", str(tmp_path / "pictures")]
    answer = json.loads(run(lid(upper=90), str(twin), "--motion", "--json", *pictures)[1])
    drawn = [one["file"] for file in answer["coordinates"] for one in file["pictures"]]
    names = ["box.lid.degrees_for_radians.png", "box.lid.degrees_for_radians.2.png"]
    assert drawn == [str(tmp_path / "pictures" / name) for name in names]


def test_pictures_show_the_part_in_orange_where_it_is_worst(run, lid, tmp_path):
    folder = tmp_path / "new" / "pictures"
    status, out, _ = run(lid(sign=""), "--motion", "--pictures", str(folder))
    assert status == 0
    assert f"1 picture in {folder}" in out
    (file,) = folder.iterdir()
    assert file.name == "lid.flipped_axis.png"
    pixels = np.asarray(Image.open(file), dtype=int)
    orange = (
        (pixels[..., 0] > 120)
        & (pixels[..., 0] > 1.5 * pixels[..., 2])
        & (pixels[..., 1] < 0.8 * pixels[..., 0])
    )
    blue = (pixels[..., 2] > 100) & (pixels[..., 2] > 1.3 * pixels[..., 0])
    assert orange.mean() > 0.01
    assert blue.mean() > 0.02
    data = json.loads(run(lid(sign=""), "--motion", "--pictures", str(folder), "--json")[1])
    assert data["coordinates"][0]["pictures"] == [{"kind": "flipped_axis", "file": str(file)}]


def test_pictures_without_motion_are_wrong_use(run, lid, tmp_path):
    status, _, err = run(lid(), "--pictures", str(tmp_path))
    assert status == 2
    assert "Add --motion" in err


def test_the_extra_is_named_if_it_is_missing(run, lid, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "coal", None)
    status, _, err = run(lid(), "--motion")
    assert status == 2
    assert "geometry" in err
