"""Draw the pictures and clips of the docs. With names or patterns, some of them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path

import living
import lockbox
import near
import numpy as np
from configurations import TAKES, Take, values
from example_pictures import EXAMPLE_PICTURES, MOVING_EXAMPLES
from films import FILMS, draw_film
from peers import PEERS, draw_peer, draw_targets
from scene_cameras import fit_scene_camera
from skills import SKILL_PICTURES, draw_fetch, draw_push
from small_files import encode_small_clip, encode_small_picture
from study_figures import STUDIES, draw_study
from tour import draw_tour

import kineverse as kv
from kineverse import gallery
from kineverse.view import picture
from kineverse.view.poses import complete

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
WIDTH, GAP = 480, 4

Drawn = np.ndarray | list[np.ndarray]


def list_pictures() -> Mapping[str, Callable[[], Drawn]]:
    """Return the functions that draw the pictures, by file name."""
    found: dict[str, Callable[[], Drawn]] = {}
    for name, take in TAKES.items():
        found[f"{name}.png"] = lambda name=name, take=take: draw_gallery_scene(name, take)
    for name in FILMS:
        found[f"{name}.webp"] = lambda name=name: draw_film(name)
    for name, draw in EXAMPLE_PICTURES.items():
        found[f"{name}.{'webp' if name in MOVING_EXAMPLES else 'png'}"] = draw
    for name in PEERS:
        found[f"{Path(name).name}.png"] = lambda name=name: draw_peer(name)
    for name in STUDIES:
        found[f"reproduce_{name}.png"] = lambda name=name: draw_study(name)
    return (
        found
        | {f"{name}.png": draw for name, draw in SKILL_PICTURES.items()}
        | {
            "near.png": near.draw_proximity,
            "living.png": living.draw_living_kitchen,
            "lockbox.png": lockbox.draw_thesis_box,
            "inverse_kinematics_ur10.png": draw_targets,
            "open_close.webp": draw_tour,
            "open_fetch.webp": draw_fetch,
            "push_hsr.webp": draw_push,
        }
    )


def main() -> int:
    """Draw what was asked for; return how many scenes and names nobody says how to draw."""
    parser = argparse.ArgumentParser(prog="python tools/pictures", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="names or patterns, such as '1*' (all)")
    known, missing = list_pictures(), 0
    for name in sorted(set(gallery.names()) - set(TAKES)):
        missing += 1
        sys.stderr.write(f"configurations.py does not say how '{name}' is drawn\n")
    for pattern in parser.parse_args().names or ["*"]:
        chosen = [name for name in known if fnmatchcase(name, pattern) or Path(name).stem == pattern]
        if not chosen:
            missing += 1
            sys.stderr.write(f"there is no picture '{pattern}'\n")
        for name in chosen:
            write(name, known[name]())
    return missing


def write(name: str, drawn: Drawn) -> None:
    """Write a picture or a clip to the folder of pictures, and say how large it is."""
    data = encode_small_clip(name, drawn) if isinstance(drawn, list) else encode_small_picture(name, drawn)
    (FOLDER / name).write_bytes(data)
    sys.stdout.write(f"{name}: {len(data)} bytes\n")


def draw_gallery_scene(name: str, take: Take) -> np.ndarray:
    """Return the panels of a scene side by side, or all in one."""
    model = kv.Model()
    if take.together:
        state = {}
        for k, part in enumerate(take.states):
            model.include(f"articulations/{name}", prefix=f"{k}")
            state |= values(f"{k}", part)
            if k:  # One floor is enough.
                with model.edit() as edit:
                    edit.remove(f"frame {k}/floor")
        states = [complete(model, state)]
    else:
        model.include(f"articulations/{name}")
        states = [complete(model, values(name, state)) for state in take.states]
    count = len(states)
    alone = WIDTH if take.together else WIDTH // 2
    size = ((WIDTH - GAP * (count - 1)) // count if count > 1 else alone, take.height)
    for state in states:
        violated = model.violations(kv.State(state))
        if violated:
            raise ValueError(f"{name} at {state}: {violated}")
    eye = fit_scene_camera(model, states, take.azimuth, take.elevation, size[0] / size[1])
    panels = [picture(model, state, size, eye) for state in states]
    gap = np.full((take.height, GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([part for panel in panels for part in (panel, gap)][:-1], axis=1)


if __name__ == "__main__":
    sys.exit(main())
