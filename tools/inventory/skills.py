"""What robots do in kitchens, by the command line, and plans for locked boxes."""

from __future__ import annotations

import json
import re
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from inventory.bounded import CACHE, each, run

KITCHENS, ROBOTS, SKILLS = range(6), ("fetch", "hsr", "pr2"), ("close", "open", "push")
OUT_OF_REACH = ("wall", "upper", "top")
BOXES = 200


def skills(data: Path | None) -> dict[str, Any]:
    """Return outcomes of skills in generated kitchens: an object each, drawn by the seed of the kitchen."""
    return dict(_skills())


def _skills() -> Iterator[tuple[str, Any]]:
    import kineverse as kv

    with tempfile.TemporaryDirectory() as folder:
        for kitchen in KITCHENS:
            names = sorted(str(symbol) for symbol in kv.load(f"kitchens/{kitchen}").degrees_of_freedom)
            reached = [name for name in names if not any(part in name for part in OUT_OF_REACH)]
            for robot in ROBOTS:
                for skill in SKILLS:
                    seed = [kitchen, ROBOTS.index(robot), SKILLS.index(skill)]
                    what = str(np.random.default_rng(seed).choice(reached))
                    words = [skill, f"kitchens/{kitchen}", "--robot", robot, "--what", what, "--json"]
                    yield " ".join(words[:-1]), _outcome(words, Path(folder))


def _outcome(words: list[str], folder: Path) -> dict[str, Any]:
    changes = {CACHE: str(folder / "cache")}
    ended = run([sys.executable, "-m", "kineverse", *words], 240, folder, changes)
    if ended.status not in (0, 1):
        reason = (ended.err.strip().splitlines() or [""])[-1]
        return {"status": ended.status, "reason": reason, "seconds": ended.seconds}
    said = json.loads(ended.out)
    return {
        "status": ended.status,
        "done": said["done"],
        "value": None if said["value"] is None else round(said["value"], 3),
        "reason": re.sub(r"\b\d+\.\d+\b", "#", said["reason"]),
        "keys": sorted(said),
        "measures": sorted(said["measures"]),
        "seconds": ended.seconds,
    }


def locks(data: Path | None) -> dict[str, Any]:
    """Return plans for boxes with random locks: the verdict, the steps, and how the reason begins."""
    seeds = range(BOXES)
    plans = each(plan_box, seeds, 60)
    return {f"box {seed}": plan for seed, plan in zip(seeds, plans, strict=True)}


def plan_box(seed: int) -> dict[str, Any]:
    """Return the plan for one box."""
    from lockboxes import draw_box, make_model

    from kineverse.reasoning import plan_unlocking

    box = draw_box(seed)
    model = make_model(box)
    begin = time.process_time()
    plan = plan_unlocking(model, box.goal, box.start)
    seconds = time.process_time() - begin
    steps = [f"{step.coordinate} {step.target:.9f}" for step in plan.steps]
    return {
        "verdict": plan.verdict,
        "steps": len(steps),
        "digest": zlib.crc32("\n".join(steps).encode()),
        "reason": plan.reason,
        "seconds": round(seconds, 4),
    }
