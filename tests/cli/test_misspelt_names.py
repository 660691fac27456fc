"""A misspelt model, frame, joint, pattern, command or option is answered with the nearest, by every command."""

from __future__ import annotations

from typing import Any

import pytest

GRIP = ("reach", "fetch", "fetch/gripper_link", "--pose", "0.7", "0.2", "0.9")
DOOR = ("--robot", "hsr", "--what", "kitchen/fridge_door")


@pytest.mark.parametrize(
    ("line", "right"),
    [
        ("inof kitchen", "info"),
        ("info kitchen --jsno", "--json"),
        ("open kitchen --robbot hsr", "--robot"),  # and not that --robot is missing
        ("--verbsoe info kitchen", "--verbose"),
        ("-x", "--help"),  # and not that a command is missing
        ("info kithcen", "kitchen"),
        ("info articulations/scrw", "articulations/screw"),
        ("unlock lockboxes/thesi --goal lockbox/a=1.2", "lockboxes/thesis"),
        ("view kithcen", "kitchen"),
        ("validate kithcen", "kitchen"),
        ("diff kitchen kithcen", "kitchen"),
        ("convert kithcen a.urdf", "kitchen"),
        ("fk kitchen kitchen/fridge_dor", "kitchen/fridge_door"),
        ("fk kitchen kitchen/fridge_door --relative-to kitchen/fridge_dor", "kitchen/fridge_door"),
        ("fk kitchen kitchen/fridge_door --set kitchen/fridge_dor=1", "kitchen/fridge_door"),
        ("view kitchen --set kitchen/fridge_dor=1 --picture a.png", "kitchen/fridge_door"),
        ("reach fetch fetch/gripper_lnk --pose 0.7 0.2 0.9", "fetch/gripper_link"),
        ("reach fetch fetch/gripper_link --pose fetch/gripper_lnk", "fetch/gripper_link"),
        (" ".join((*GRIP, "--still", "fetc/*")), "fetch/*"),
        (" ".join((*GRIP, "--still", "fetch/bas")), "fetch/base"),
        (" ".join((*GRIP, "--from", "fetch/torso_lift_jont=0.1")), "fetch/torso_lift_joint"),
        pytest.param("plan shelf_door --to shelf_door/dor=80deg", "shelf_door/door", marks=pytest.mark.long),
        pytest.param(
            "plan shelf_door --to shelf_door/door=80deg --move shelf_dor/*",
            "shelf_door/*",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "plan shelf_door --to shelf_door/door=80deg --leave-out shelf_dor/*",
            "shelf_door/*",
            marks=pytest.mark.long,
        ),
        ("unlock lockboxes/thesis --goal lockbox/aa=1.2", "lockbox/a"),
        ("unlock lockboxes/thesis --goal lockbox/a=1.2 --still lokbox/*", "lockbox/*"),
        ("unlock lockboxes/thesis --goal lockbox/a=1.2 --execute --jam lokbox/*", "lockbox/*"),
        ("convert kitchen a.urdf --leave-out kitchn/*", "kitchen/*"),
        ("spheres fetch --links fetch/gripper_lnk", "fetch/gripper_link"),
        ("spheres fetch --links fetc/*", "fetch/*"),
        ("open kitchen --robot hsrr --what kitchen/fridge_door", "hsr"),
        ("open kitchen --robot hsr --what kitchen/fridge_dor", "kitchen/fridge_door"),
        ("push kitchen --robot hsr --what kitchen/fridge_dor", "kitchen/fridge_door"),
        pytest.param(
            "live --what kitchen/fridge_dor --headless", "kitchen/fridge_door", marks=pytest.mark.long
        ),
        ("serve kithcen", "kitchen"),
    ],
)
def test_the_nearest_name_is_said(run: Any, line: str, right: str) -> None:
    status, out, err = run(*line.split())
    assert (status, out) == (2, "")
    assert err.startswith("kineverse: ")
    assert len(err.splitlines()) == 1
    hint = err.partition("Did you mean")[2] or err.partition("Available")[2]
    assert right in hint, err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("fk kitchen kitchen/fridge_door_handle --set kitchen/fridge_door=12cm", "is in rad"),
        (" ".join((*GRIP, "--from", "fetch/torso_lift_joint=90deg")), "is in m"),
        pytest.param("plan shelf_door --to shelf_door/door=80cm", "is in rad", marks=pytest.mark.long),
        pytest.param(
            "plan shelf_door --to shelf_door/door=1 --from shelf_door/door=80cm",
            "is in rad",
            marks=pytest.mark.long,
        ),
        (" ".join(("open", "kitchen", *DOOR, "--to", "20cm")), "is in rad"),
        (" ".join(("open", "kitchen", *DOOR, "--set", "kitchen/oven_door=12cm")), "is in rad"),
        ("reach fetch fetch/gripper_link --pose 0.7deg 0.2 0.9", "is not a length"),
        ("reach fetch fetch/gripper_link --pose 0.7 0.2 0.9 0 90cm 0", "is not an angle"),
        pytest.param(
            "plan fetch --to fetch/gripper_link@0.7deg,0.2,0.9", "is not a length", marks=pytest.mark.long
        ),
    ],
)
def test_a_unit_of_another_kind_is_refused(run: Any, line: str, said: str) -> None:
    status, out, err = run(*line.split())
    assert (status, out) == (2, "")
    assert said in err


def test_help_and_verbose_are_taken_before_and_after_the_command(run: Any) -> None:
    assert run("--help", "info") == run("-v", "--help", "info") == run("info", "kitchen", "--help")
    assert run("-v", "info", "kitchen") == run("info", "kitchen", "-v") == run("info", "-v", "kitchen")


def test_positions_and_speeds_have_units(run: Any) -> None:
    _, out, _ = run(*GRIP)
    lines = {line.split()[0]: line for line in out.splitlines()[1:]}
    assert lines["fetch/torso_lift_joint"].endswith(" m")
    assert lines["fetch/elbow_flex_joint"].endswith(" rad")
    assert "speed [/s]" in run("info", "fetch")[1]
