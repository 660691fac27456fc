"""``python examples/living_kitchen``: a kitchen in motion in the browser, or its numbers and a picture.

It is tracked from noisy markers, and the joint of a mechanism of unknown type, the stranger, is identified.
With ``--headless`` this needs nothing beyond the core.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

# Python puts this folder on the path, where its modules could hide others of their names.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from kineverse.cli.output import format_table, show_progress  # noqa: E402
from kineverse.cli.pages import (  # noqa: E402
    add_page_options,
    check_file_path,
    check_picture_path,
    handle_interrupts,
    page_options,
    print_address,
)
from kineverse.errors import InvalidValueError, KineverseError  # noqa: E402
from living_kitchen.picture import save  # noqa: E402 - after the path
from living_kitchen.report import tabulate_identification, tabulate_tracking  # noqa: E402
from living_kitchen.simulation import Simulation  # noqa: E402
from living_kitchen.track import TrackingQuality, average  # noqa: E402
from living_kitchen.unknown_mechanisms import MECHANISMS  # noqa: E402

SECONDS, STEP, SETTLED = 18.0, 1.0 / 12.0, 3.0
"""Duration and time step without a browser, and the time from which the quality counts [s]."""
LONGEST = 3600.0  # the longest duration [s]


def main(words: list[str] | None = None) -> int:
    """Run the kitchen in motion; return 0, or 2 for a mistake, which is printed."""
    parser = argparse.ArgumentParser(prog="living_kitchen", description=(__doc__ or "").partition("\n\n")[2])
    parser.add_argument(
        "--stranger", choices=sorted(MECHANISMS), default="chest", help="the unknown mechanism (chest)"
    )
    parser.add_argument("--headless", action="store_true", help="numbers and a picture instead of a page")
    parser.add_argument(
        "--picture", metavar="PATH", default="living.png", help="with --headless, a .png (living.png)"
    )
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, metavar="S", help=f"with --headless: how long ({SECONDS:g})"
    )
    add_page_options(parser)
    arguments = parser.parse_args(words)
    try:
        return simulate(arguments) if arguments.headless else show(arguments)
    except (KineverseError, OSError) as error:
        print(f"living_kitchen: {error}", file=sys.stderr)
        return 2


def show(arguments: argparse.Namespace) -> int:
    """Show the kitchen on a page until Ctrl-C."""
    from living_kitchen.page import SimulationPage  # it needs viser

    simulation = Simulation(mechanism=arguments.stranger)
    with (
        handle_interrupts(),
        SimulationPage(simulation, label="Living kitchen", **page_options(arguments)) as page,
    ):
        print_address(page, browser=not arguments.no_browser)
        print(f"{page.simulation.kitchen}, tracked; a {page.simulation.mechanism.name}, learned", flush=True)
        page.wait()
    return 0


def simulate(arguments: argparse.Namespace) -> int:
    """Run the simulation without a browser, print its results, and write a picture of its end."""
    if not STEP <= arguments.seconds <= LONGEST:
        raise InvalidValueError(f"--seconds is between {STEP:.2g} and {LONGEST:g}, not {arguments.seconds!r}")
    # First, so that an unwritable path is reported before the work.
    check_picture_path(arguments.picture)
    check_file_path(arguments.picture)
    simulation = Simulation(mechanism=arguments.stranger)
    qualities: list[TrackingQuality] = []
    for _ in show_progress(range(round(arguments.seconds / STEP)), "living", "step"):
        simulation.step(STEP)
        if simulation.time > SETTLED or not qualities:
            qualities.append(simulation.quality)
    print(format_table(*tabulate_tracking(simulation, average(qualities)), "<>"), end="\n\n")
    print(format_table(*tabulate_identification(simulation), "<>"))
    save(arguments.picture, simulation)
    print(f"picture: {arguments.picture}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
