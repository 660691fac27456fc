"""Strings that documents have for classes stay what they are, and with them the digests of models.

``digests.json`` has the digests of models as they were before the classes were renamed, and with the datum of
what a URDF says besides since then. ``exact`` has those
whose numbers come from Python's arithmetic and the C library; they came out equal with every kernel of OpenBLAS
(``OPENBLAS_CORETYPE=Prescott`` to ``SkylakeX``), without FMA in the C library and without AVX in numpy. The
scenes in :data:`SOLVED` have numbers that LAPACK or BLAS computes, whose last bits depend on the processor;
``strings`` has a digest of all strings in their documents instead.

``python tests/documents/test_frozen_names.py`` prints the table for the models of this checkout.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from document_models import Doubled, rich_model
from scenes import SCENES, build_scene, scene_document

import kineverse as kv
from kineverse import gallery
from kineverse.articulations import joint
from kineverse.articulations.mechanisms import latched_doors
from kineverse.formats.document import to_json
from kineverse.formats.document.opaque_operation import OpaqueOperation
from kineverse.formats.document.parameters import CLASSES, document_kind, find_class
from kineverse.formats.locate import shipped_models
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Mesh, Sphere
from kineverse.model.operation import Operation

FOLDER = Path(__file__).parent
DIGESTS: dict[str, dict[str, str]] = json.loads((FOLDER / "digests.json").read_text("utf-8"))

SOLVED = {
    "cam": "coefficients of the spline, from a linear system",
    "mecanum": "places of the rollers, products of matrices",
    **dict.fromkeys(
        (
            "four_bar",
            "slider_crank",
            "spatial_four_bar",
            "parallel_gripper",
            "scissor_linkage",
            "delta_robot",
            "jansen_leg",
        ),
        "initial guess of the loop, fitted to states that Newton's method found",
    ),
}
"""Scenes with numbers that depend on the processor, and which."""

LARGE = ("delta_robot", "jansen_leg", "parallel_gripper", "scissor_linkage")
"""Scenes of those that take long to be solved, and whose strings come from the same classes as the others'."""

MODELS = (
    *shipped_models(),
    *(f"articulations/{scene}" for scene in SCENES),
    "rich_model",
    *(f"released/{path.name}" for path in sorted(FOLDER.glob("released/*.kv.json"))),
)

KINDS = {
    "kineverse.model.basic_operations": {
        "AddFrame": "AddFrame",
        "Attach": "Attach",
        "Constrain": "Constrain",
        "Override": "Override",
        "SetBody": "SetBody",
        "SetData": "Write",
        "SetHome": "SetHome",
        "SetRate": "SetRate",
        "SoftLimits": "SoftLimits",
    },
    "kineverse.loops": {"CloseLoop": "CloseLoop", "LoopConstraint": "LoopConstraint"},
    "kineverse.articulations": {
        "Ackermann": "Ackermann",
        "Ball": "Ball",
        "Cam": "Cam",
        "Continuous": "Continuous",
        "Cylindrical": "Cylindrical",
        "DeskLamp": "DeskLamp",
        "DifferentialDrive": "DifferentialDrive",
        "DoorWithHandle": "DoorWithHandle",
        "Faucet": "Faucet",
        "Fixed": "Fixed",
        "Floating": "Floating",
        "FoldingDoor": "FoldingDoor",
        "GarageDoor": "GarageDoor",
        "Gearbox": "Gearbox",
        "Latch": "Latch",
        "Mecanum": "Mecanum",
        "Microwave": "Microwave",
        "OmniBase": "OmniBase",
        "PedalBin": "PedalBin",
        "PistonAndRod": "PistonAndRod",
        "Planar": "Planar",
        "Prismatic": "Prismatic",
        "RackAndPinion": "RackAndPinion",
        "Ratchet": "Ratchet",
        "Revolute": "Revolute",
        "ScissorLift": "ScissorLift",
        "Screw": "Screw",
        "ScrewAndNut": "ScrewAndNut",
        "Universal": "Universal",
    },
    "kineverse.formats.mjcf.equalities": {"Tendon": "Tendon", "TendonCoupling": "TendonCoupling"},
    "kineverse.estimation.identification.joint_operations": {
        "FamilyJoint": "FamilyJoint",
        "MountedBall": "MountedBall",
        "MountedCylindrical": "MountedCylindrical",
        "MountedRevolute": "MountedRevolute",
        "MountedScrew": "MountedScrew",
        "SlidingPoint": "SlidingPoint",
    },
    "kineverse.estimation.plausibility.replacement": {"ReplacedJoint": "Relearned"},
}
"""Operations that ship, by module and class, with the kind that documents have for them."""

PARAMETERS = {
    "kineverse.articulations": {"Limits": "Limits"},
    "kineverse.model.articulation": {"Articulation": "Articulation"},
    "kineverse.model.body": {
        "Body": "Body",
        "Box": "Box",
        "Capsule": "Capsule",
        "Cone": "Cone",
        "Cylinder": "Cylinder",
        "Ellipsoid": "Ellipsoid",
        "Inertia": "Inertia",
        "Mesh": "Mesh",
        "Shape": "Shape",
        "Sphere": "Sphere",
    },
    "kineverse.model.constraint": {"Constraint": "Constraint"},
    "kineverse.model.frame": {"Frame": "Frame"},
    "kineverse.estimation.identification.families": {"Family": "Family", "FamilyMotion": "FamilyMotion"},
}
"""Other classes that are parameters of these, with the names of their records."""

ABSTRACT = {
    *(kv.articulations.Base, kv.articulations.Joint, kv.articulations.Mechanism),
    *(kv.articulations.OneAxisMotion, kv.articulations.OneDofJoint, kv.articulations.Transmission),
    *(joint.PlacedOperation, latched_doors.HingedDoor, latched_doors.SprungDoor, OpaqueOperation),
}
"""Base classes, which no document names, and the one whose kind is an attribute."""


def load(name: str) -> kv.Model:
    if name == "rich_model":
        return rich_model()
    if name.startswith("articulations/"):
        scene = name.removeprefix("articulations/")
        return build_scene(scene, prefix=scene)
    return kv.load(FOLDER / name if name.startswith("released/") else name)


def strings(value: Any) -> Iterator[str]:
    """Yield all strings of a JSON value, keys of objects too."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value:
            yield from strings(item)
            if isinstance(value, dict):
                yield from strings(value[item])


def strings_digest(text: str) -> str:
    """Return the digest of the different strings in a document, without that of its content."""
    document = json.loads(text)
    del document["sha256"]
    return hashlib.sha256("\n".join(sorted(set(strings(document)))).encode()).hexdigest()


def digests() -> dict[str, dict[str, str]]:
    solved = {f"articulations/{scene}" for scene in SOLVED}
    return {
        "exact": {name: kv.formats.document_hash(load(name)) for name in MODELS if name not in solved},
        "strings": {name: strings_digest(to_json(load(name))) for name in MODELS if name in solved},
    }


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name in LARGE else ()) for name in SCENES]
)
def test_document_of_a_scene_is_what_the_tool_writes(name: str) -> None:
    """``python tools/scenes`` writes it."""
    text, written = gallery.find_document(name).read_text(encoding="utf-8"), scene_document(name)
    if name in SOLVED:
        assert strings_digest(text) == strings_digest(written)
    else:
        assert text == written


@pytest.mark.parametrize("name", DIGESTS["exact"])
def test_digest_of_a_model_is_the_committed_one(name: str) -> None:
    assert kv.formats.document_hash(load(name)) == DIGESTS["exact"][name]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name.endswith(LARGE) else ())
        for name in DIGESTS["strings"]
    ],
)
def test_strings_of_a_solved_scene_are_the_committed_ones(name: str) -> None:
    assert strings_digest(to_json(load(name))) == DIGESTS["strings"][name]


def test_every_model_has_a_digest() -> None:
    assert sorted([*DIGESTS["exact"], *DIGESTS["strings"]]) == sorted(MODELS)
    assert set(DIGESTS["strings"]) == {f"articulations/{scene}" for scene in SOLVED}


@pytest.mark.parametrize("module", [*KINDS, *PARAMETERS])
def test_document_kind_of_a_class_is_frozen(module: str) -> None:
    expected = (KINDS | PARAMETERS)[module] | KINDS.get(module, {})
    found = {name: document_kind(getattr(importlib.import_module(module), name)) for name in expected}
    assert found == expected


@pytest.mark.parametrize("module", KINDS)
def test_every_operation_that_ships_has_a_frozen_kind(module: str) -> None:
    members = [member for _, member in inspect.getmembers(importlib.import_module(module))]
    kinds = {m for m in members if inspect.isclass(m) and issubclass(m, Operation)}
    here = {k for k in kinds if not inspect.isabstract(k)} - ABSTRACT - {Operation}
    known = {kind for names in KINDS.values() for kind in names.values()}
    unknown = {kind.__name__ for kind in here if kind.document_kind not in known} - {"Mounted"}
    assert not unknown


def test_records_have_frozen_names() -> None:
    parameters = {name for names in PARAMETERS.values() for name in names.values()}
    operations = {
        kind
        for module in ("kineverse.model.basic_operations", "kineverse.loops", "kineverse.articulations")
        for kind in KINDS[module].values()
    }
    left_out = {"Family", "FamilyMotion"}
    assert set(CLASSES) == (parameters | operations) - left_out
    assert [document_kind(find_class(name)) for name in CLASSES] == list(CLASSES)


def test_kinds_of_geometries_are_frozen() -> None:
    kinds = [kind.kind for kind in (Box, Cylinder, Capsule, Sphere, Ellipsoid, Cone, Mesh)]
    assert kinds == ["box", "cylinder", "capsule", "sphere", "ellipsoid", "cone", "mesh"]


def test_a_class_of_a_user_has_its_own_name() -> None:
    @dataclass(frozen=True, kw_only=True)
    class MyHinge(kv.Revolute):
        pass

    hinge = MyHinge(name="hinge", parent="world", child="leaf")
    assert (document_kind(MyHinge), hinge.kind, hinge.noun) == ("MyHinge", "myhinge", "my hinge")
    assert document_kind(Doubled) == "Doubled"
    assert Doubled("a", "b").default_tag() == "doubled"


def test_tags_and_kinds_of_mechanisms_follow_the_frozen_name() -> None:
    door = kv.articulations.DoorWithHandle(name="door", parent="world")
    assert (door.kind, door.default_tag()) == ("doorwithhandle", "door with handle door")


if __name__ == "__main__":
    print(json.dumps(digests(), indent=1))
