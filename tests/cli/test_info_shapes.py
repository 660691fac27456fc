"""``kineverse info`` lists bodies without collision shapes."""

import json

import pytest

from kineverse.cli import main

SEEN = '<visual><geometry><box size="1 1 1"/></geometry></visual>'
TOUCHED = '<collision><geometry><sphere radius="1"/></geometry></collision>'
JOINT = '<joint name="{0}" type="fixed"><parent link="a"/><child link="{0}"/></joint>'


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
