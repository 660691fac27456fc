"""Generated kitchens: the numbers that their documentation promises, and room for every object to open."""

import itertools
import math
import subprocess
import sys

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import UnknownNameError
from kineverse.gallery import kitchens
from kineverse.gallery.kitchens import layout
from kineverse.geometry import Rule, Scene
from kineverse.model.body import Body, Box, Cylinder

SEEDS = (11, 89, pytest.param(2, marks=pytest.mark.long), pytest.param(12, marks=pytest.mark.long))
"""With most kinds of units; an island, a second row and a bare wall; a folding door and flaps above."""
OPENED = (0.02, 0.25, 0.5, 0.75, 1.0)


def _upper(model, q):
    return float(model.constraints[f"{q}/position"].upper)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", SEEDS)
def test_generate_kitchen_each_object_opens_without_contact(seed):
    model = kitchens.generate_kitchen(seed)
    # All pairs that can move relative to each other, with those that a scene takes for joined.
    scene = Scene(model, rules=[Rule("*", "*", True)])
    rigid = {pair for pair in itertools.combinations(scene.bodies, 2) if not model.fk(*pair).symbols}

    def contacts(state):
        scene.update(state)
        found = scene.pairs_within(1e-4)
        return [(d.a, d.b) for d in found if (d.a, d.b) not in rigid and (d.b, d.a) not in rigid]

    shut = model.default_state()
    assert contacts(shut) == []
    for q, part in itertools.product(model.degrees_of_freedom, OPENED):
        assert contacts(shut.updated({q: part * _upper(model, q)})) == [], (q, part)


def test_generate_kitchen_finds_contact_of_two_open_doors():
    """The test above can fail: doors of neighbours that are both open are in each other's way."""
    model = kitchens.generate_kitchen(11)
    scene = Scene(model)
    everything = {q: _upper(model, q) for q in model.degrees_of_freedom}
    scene.update(model.default_state().updated(everything))
    assert scene.in_collision


def test_generate_kitchen_numbers_are_those_of_the_documentation():
    kinds, counts, aisles = set(), [], []
    for seed in range(1000, 1030):
        model = kitchens.generate_kitchen(seed)
        shut, objects = model.default_state(), model.degrees_of_freedom
        counts.append(len(objects))
        assert layout.OBJECTS[0] <= len(objects) <= layout.OBJECTS[1]
        for q in objects:
            record = model.articulations[q.path]
            kinds.add(record.kind)
            upper = _upper(model, q)
            assert upper in (1.5, 1.57, 1.84, 1.9) if record.kind != "prismatic" else 0.35 <= upper <= 0.5
            handle = f"{q}/handle" if record.kind == "foldingdoor" else f"{q}_handle"
            assert 0.15 <= model.fk(handle)(shut)[2, 3] <= 1.9
            dynamics = dict(record.dynamics)
            assert record.kind == "foldingdoor" or (dynamics["damping"] > 0 and dynamics["friction"] > 0)
            if record.kind != "foldingdoor":
                _check_bar(model.bodies[handle])
        for name, body in model.bodies.items():
            assert body.inertia is not None, name
            assert body.inertia.mass > 0, name
        rows = [n for n in model.frames if n.startswith("kitchen/row_") and n.count("_") == 1]
        aisles.append(2 * model.fk(rows[0])(shut)[0, 3])
    assert kinds == {"revolute", "prismatic", "foldingdoor"}
    assert set(counts) == set(range(8, 15))
    assert layout.AISLES[0] <= min(aisles) < 1.1
    assert 1.5 < max(aisles) <= layout.AISLES[1]


def _check_bar(body: Body):
    """Check a bar along y at a distance from the front, on two mounts."""
    bar, *mounts = body.collisions
    if isinstance(bar.geometry, Cylinder):
        length, thickness = bar.geometry.length, 2 * bar.geometry.radius
    else:
        assert isinstance(bar.geometry, Box)
        thickness, length, _ = bar.geometry.size
    assert 0.1 <= length <= 0.4
    assert 0.008 <= thickness <= 0.016
    assert len(mounts) == 2
    clearance = bar.origin.matrix[0, 3] - thickness / 2
    assert 0.025 - 1e-9 <= clearance <= 0.045 + 1e-9


def test_generate_kitchen_spring_of_a_flap_carries_it_wide_open():
    """At 90° the spring's torque is the weight's: k π/2 = m g d, with d from the body's inertia."""
    model, flap = kitchens.generate_kitchen(1), "kitchen/oven_door"
    inertia, dynamics = model.bodies[flap].inertia, dict(model.articulations[flap].dynamics)
    weight = inertia.mass * 9.81 * inertia.origin.matrix[2, 3]
    assert dynamics["spring_stiffness"] * math.pi / 2 == pytest.approx(weight, rel=1e-3)


def test_generate_kitchen_inertia_is_that_of_mujoco():
    mujoco = pytest.importorskip("mujoco")
    from kineverse.gallery.kitchens.builder import STEEL, compute_inertia, cylinder_between, slab

    solids = (
        slab((0.1, 0.4), (-0.2, 0.1), (0, 0.05), STEEL),
        cylinder_between((0, 0.1, 0), (0, 0.5, 0), 0.02, STEEL),
    )
    box, bar = solids
    x, y, z = box.shape.origin.matrix[:3, 3]
    xml = f"""<mujoco><compiler inertiafromgeom='true'/><worldbody><body><freejoint/>
      <geom type='box' size='.15 .15 .025' pos='{x} {y} {z}' density='450'/>
      <geom type='cylinder' size='.02' fromto='0 .1 0 0 .5 0' density='450'/></body></worldbody></mujoco>"""
    m, found = mujoco.MjModel.from_xml_string(xml), compute_inertia((box, bar))
    xx, xy, xz, yy, yz, zz = found.tensor
    own = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    assert found.mass == pytest.approx(m.body_mass[1], rel=1e-5)
    assert found.origin.matrix[:3, 3] == pytest.approx(m.body_ipos[1], abs=1e-6)
    assert own == pytest.approx(sorted(m.body_inertia[1]), rel=1e-4)


def test_load_kitchen_is_the_same_in_another_process(tmp_path):
    path = tmp_path / "there.kv.json"
    program = f"import kineverse as kv; kv.load('kitchens/17').save({str(path)!r})"
    subprocess.run([sys.executable, "-c", program], check=True)
    here = kv.load("kitchens/17")
    here.save(tmp_path / "here.kv.json")
    assert (tmp_path / "here.kv.json").read_bytes() == path.read_bytes()
    assert here.degrees_of_freedom == kitchens.generate_kitchen(17).degrees_of_freedom
    other = kv.load("kitchens/17", prefix="left")
    assert {name.partition("/")[0] for name in other.frames} == {"left"}


@pytest.mark.parametrize("name", ["-1", "017", "x", "", "1.5", "²", "1" * 19])
def test_load_kitchen_refuses_what_is_no_seed(name):
    with pytest.raises(UnknownNameError, match=r"Load one as 'kitchens/0'|Available: 0, 1"):
        kv.load(f"kitchens/{name}")
    with pytest.raises(UnknownNameError, match="a whole number from 0"):
        list(kitchens.kitchen_operations(name))
