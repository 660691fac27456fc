"""Scenes of the mechanisms."""

from __future__ import annotations

from kineverse.articulations.mechanisms import (
    DeskLamp,
    DoorWithHandle,
    Faucet,
    FoldingDoor,
    GarageDoor,
    Latch,
    Microwave,
    PedalBin,
    PistonAndRod,
    Ratchet,
    ScissorLift,
    ScrewAndNut,
)
from kineverse.articulations.mechanisms.mechanism import STEEL

from .scene_builder import SceneBuilder
from .shapes import RED, box, rod, sphere


def garage_door(scene: SceneBuilder) -> None:
    """Show a garage door, locked by its bolt while it is closed."""
    scene.mechanism(GarageDoor, "garage")


def garage_door_as_published(scene: SceneBuilder) -> None:
    """Show the garage door with the coordinate of the papers, whose slope is infinite where it is closed."""
    scene.mechanism(GarageDoor, "garage", form="published")


def folding_door(scene: SceneBuilder) -> None:
    """Show a cupboard whose door folds while it rises; a spring opens it, and past a point shuts it."""
    scene.mechanism(FoldingDoor, "door")


def door_with_handle(scene: SceneBuilder) -> None:
    """Show a door that opens while its handle is pressed."""
    scene.mechanism(DoorWithHandle, "room")


def latch(scene: SceneBuilder) -> None:
    """Show a door that a sprung bolt holds shut."""
    scene.mechanism(Latch, "gate", width=0.4, height=0.6, thickness=0.05)


def microwave(scene: SceneBuilder) -> None:
    """Show a microwave, whose button lets the door go."""
    scene.mechanism(Microwave, "oven")


def faucet(scene: SceneBuilder) -> None:
    """Show a tap: its lever is lifted for more water and turned for warmer water."""
    scene.mechanism(Faucet, "tap")


def piston(scene: SceneBuilder) -> None:
    """Show a piston that a crank moves by a rod, over the whole turn."""
    scene.mechanism(PistonAndRod, "engine")


def pedal_bin(scene: SceneBuilder) -> None:
    """Show a bin whose lid a pedal opens."""
    scene.mechanism(PedalBin, "bin")


def screw_and_nut(scene: SceneBuilder) -> None:
    """Show a screw that turns in its place, and a nut that slides along it."""
    scene.mechanism(ScrewAndNut, "vise", pitch=0.04, travel=0.16, radius=0.015)
    grip = rod((0, 0, 0.19), (0, 0, 0.22), 0.012, STEEL) + rod((0, 0, 0.22), (0.05, 0, 0.22), 0.006, RED)
    scene.frame("grip", grip + sphere(0.01, (0.05, 0, 0.22), RED), parent="vise/screw")


def scissor_lift(scene: SceneBuilder) -> None:
    """Show a platform on three pairs of crossed arms."""
    scene.mechanism(ScissorLift, "lift")


def desk_lamp(scene: SceneBuilder) -> None:
    """Show a lamp on two parallelograms, whose head keeps its direction."""
    scene.mechanism(DeskLamp, "lamp")


def ratchet(scene: SceneBuilder) -> None:
    """Show a wheel that turns one way only, until its pawl is lifted."""
    scene.mechanism(Ratchet, "winch")
    # The rotation of a plain disc is invisible.
    scene.frame("mark", box((0.006, 0.016, 0.034), (0, 0, 0.025), RED), parent="winch/wheel")


SCENES = (
    garage_door,
    garage_door_as_published,
    folding_door,
    door_with_handle,
    latch,
    microwave,
    faucet,
    piston,
    pedal_bin,
    screw_and_nut,
    scissor_lift,
    desk_lamp,
    ratchet,
)
