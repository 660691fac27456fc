"""Custom elements of written MJCF files: read back if they are valid, and ignored in edited files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mujoco_oracle import model_of
from round_trip import assert_same_motion, load_cached

import kineverse as kv
from kineverse.formats.mjcf import parse_mjcf
from kineverse.model.body import Body, Box, Inertia, Shape

LINKAGE = "articulations/slider_crank"


def written(model: kv.Model, folder: Path) -> str:
    model.save(folder / "m.xml")
    return (folder / "m.xml").read_text()


def read(text: str, prefix: str | None = None) -> kv.Model:
    return model_of(parse_mjcf(text), prefix)


def test_velocity_limits_are_read_back(tmp_path: Path) -> None:
    model, q = kv.Model(), kv.position("q")
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="q", parent="world", child="q", lower=0, upper=1, velocity=2.5))
        edit.apply(kv.Prismatic(name="p", parent="q", child="p", position=3 * q, velocity=4))
        edit.apply(kv.Continuous(name="r", parent="q", child="r"))
        edit.constrain("slower backwards", -0.1, kv.velocity("r"), 0.3)
        edit.apply(kv.Continuous(name="s", parent="q", child="s"))
        edit.constrain("onwards only", 0, kv.velocity("s"), np.inf)
    again = read(written(model, tmp_path), "left")
    for name, limits in {"q": (-2.5, 2.5), "r": (-0.1, 0.3), "s": (0.0, np.inf)}.items():
        assert again.limits(f"left/{name}:velocity") == limits
    still = {f"left/{name}": 0.5 for name in "qrs"}
    for speed in (-1.4, -1.0, 1.0, 1.4):  # of q: 4 / 3 is the most for p
        moving = {f"left/{name}:velocity": speed if name == "q" else 0.0 for name in "qrs"}
        broken = [v.name for v in again.violations({**still, **moving})]
        assert broken == (["left/p/velocity"] if abs(speed) > 4 / 3 else [])


def test_massless_frames_are_read_back_without_mass(tmp_path: Path) -> None:
    heavy = Body((Shape(Box((1, 1, 1))),), (), Inertia(2, (1, 0, 0, 1, 0, 1)))
    model = kv.Model()
    with model.edit() as edit:
        for name, body in {"a": Body(), "b": heavy, "c": Body((Shape(Box((1, 1, 1))),))}.items():
            turn = kv.rotation_z(kv.position(name))
            edit.add_frame(name, parent="world", transform=turn, body=body if body != Body() else None)
    text = written(model, tmp_path)
    assert "boundmass" in text
    again = read(text)
    assert set(again.bodies) == {"b", "c"}
    assert again.bodies["c"].inertia is None
    assert again.bodies["b"].inertia == heavy.inertia
    # Somebody has given it mass since.
    assert (
        read(text.replace('<joint name="a"', '<geom size="1" mass="3"/><joint name="a"')).bodies["a"].inertia
    )


@pytest.mark.parametrize(
    "saved",
    ["as it is", pytest.param("from a document", marks=pytest.mark.long), "from a document, below a prefix"],
)
def test_loops_are_solved_again_when_read_back(saved: str, tmp_path: Path) -> None:
    model = load_cached("articulations/parallel_gripper")
    if saved != "as it is":
        model.save(tmp_path / "m.kv.json")
        model = kv.load(tmp_path / "m.kv.json", prefix="left/a:b" if "prefix" in saved else None)
    again = read(written(model, tmp_path))
    assert set(again.frames) == set(model.frames)
    assert model.rates.dependent.keys() == again.rates.dependent.keys()
    assert_same_motion(model, again, tolerance=1e-10, count=4)


def test_loops_read_back_keep_their_branch(tmp_path: Path) -> None:
    """Both branches of a four-bar, from the same bars at the same home position."""

    def bars(branch: int) -> kv.Model:
        model = kv.Model()
        with model.edit() as edit:
            for name, parent, x in (("a", "world", 0), ("b", "a", 0.4), ("c", "world", 1.0)):
                origin = kv.model.Pose.from_matrix(kv.translation(x, 0, 0))
                limits = {"lower": -0.5, "upper": 0.5} if name == "a" else {}
                edit.apply(
                    kv.Revolute(name=name, parent=parent, child=name, axis=(0, 0, 1), origin=origin, **limits)
                )
            edit.add_frame("b_end", parent="b", transform=kv.translation(1.1, 0, 0))
            edit.add_frame("c_end", parent="c", transform=kv.translation(0.8, 0, 0))
            edit.close_loop("b_end", "c_end", name="bars", branch=branch, home={"b": 0.5, "c": 1.0})
        return model

    found = []
    for branch in (0, 1):
        model = bars(branch)
        again = read(written(model, tmp_path))
        assert_same_motion(model, again, tolerance=1e-10)
        found.append(again.fk("c_end")({"a": 0.3})[1, 3])
    assert found[0] * found[1] < 0


@pytest.mark.parametrize(
    ("before", "after", "remark"),
    [
        ('objtype="equality" objname="', 'objtype="equality" objname="no ', "is not in the file as it says"),
        ('objtype="joint" objname="', 'objtype="joint" objname="no ', "is not in the file as it says"),
        ('objtype="equality"', 'objtype="light"', "is not in the file as it says"),
    ],
)
def test_edited_custom_loops_are_ignored(before: str, after: str, remark: str, tmp_path: Path) -> None:
    text = written(load_cached(LINKAGE), tmp_path)
    assert before in text
    scene = parse_mjcf(text.replace(before, after))
    assert [r for r in scene.remarks if remark in r]
    plain = parse_mjcf(text.replace("kineverse:loop:", "other:"))
    assert scene.closures == plain.closures
    assert read(text.replace(before, after)).rates.dependent


@pytest.mark.parametrize("data", ["1 -1", "nan nan", "inf inf", "1", "1 2 3", "one two", ""])
def test_invalid_velocity_ranges_are_left_out(data: str) -> None:
    text = f"""<mujoco><custom><numeric name="kineverse:speed:q" data="{data}"/></custom><worldbody>
    <body name="b"><joint name="q"/><geom size="1"/></body></worldbody></mujoco>"""
    scene = parse_mjcf(text)
    assert [remark for remark in scene.remarks if "a range of speeds is two numbers" in remark]
    assert scene.links[1].joints[0].speed is None


def test_foreign_custom_elements_are_ignored(tmp_path: Path) -> None:
    text = written(load_cached(LINKAGE), tmp_path)
    start, end = text.index("  <custom>"), text.index("</custom>\n") + len("</custom>\n")
    without = parse_mjcf(text[:start] + text[end:])
    other = parse_mjcf(text.replace("kineverse:", "someone:"))
    assert [c.dependent for c in other.closures] == [None]
    assert [(link.name, link.joints[:0], link.body) for link in other.links] == [
        (link.name, link.joints[:0], link.body) for link in without.links
    ]
    assert [site.name for site in other.sites] == [site.name for site in without.sites] != []
