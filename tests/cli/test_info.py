"""``kineverse info`` prints the hash of a document and lists bodies without collision shapes."""

import json

import pytest

import kineverse as kv
from kineverse.cli import main

SEEN = '<visual><geometry><box size="1 1 1"/></geometry></visual>'
TOUCHED = '<collision><geometry><sphere radius="1"/></geometry></collision>'
JOINT = '<joint name="{0}" type="fixed"><parent link="a"/><child link="{0}"/></joint>'


@pytest.mark.parametrize("ending", ["kv.json", "kv.msgpack"])
def test_info_prints_the_hash_of_a_document(ending, tmp_path, capsys):
    path = tmp_path / f"door.{ending}"
    model = kv.load("shelf_door")
    model.save(path)
    assert main(["info", str(path)]) == 0
    assert f"  document, sha256 {kv.formats.document_hash(model)}\n" in capsys.readouterr().out
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sha256"] == kv.formats.document_hash(model)


def test_only_documents_have_a_hash(capsys):
    assert main(["info", "shelf_door", "--json"]) == 0
    assert "sha256" not in json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("links", "said"),
    [
        ({"a": SEEN + TOUCHED}, None),
        ({"a": SEEN, "b": SEEN + TOUCHED}, "1 body has no collision shapes"),
        ({"a": SEEN, "b": SEEN, "c": ""}, "2 bodies have no collision shapes"),
    ],
)
def test_bodies_without_collision_shapes_are_counted(tmp_path, capsys, links, said):
    file = tmp_path / "robot.urdf"
    bodies = "".join(f'<link name="{name}">{inside}</link>' for name, inside in links.items())
    joints = "".join(JOINT.format(name) for name in links if name != "a")
    file.write_text(f'<robot name="r">{bodies}{joints}</robot>')
    assert main(["info", str(file)]) == 0
    out = capsys.readouterr().out
    assert said in out if said else "collision shapes" not in out
    assert main(["info", str(file), "--json"]) == 0
    named = json.loads(capsys.readouterr().out)["touched_as_seen"]
    assert named == [name for name, inside in links.items() if inside == SEEN]
