"""``kineverse spheres``: collision shapes covered by spheres."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kineverse._names import match_names
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError
from kineverse.expressions.printing import format_number
from kineverse.geometry.objects import CollisionObjects
from kineverse.geometry.shapes import import_coal
from kineverse.planning.spheres import cover_objects
from kineverse.planning.spheres.object_covers import (
    CachedCover,
    are_covered,
    clear_covers,
    cover_folder,
    list_covers,
)
from kineverse.planning.spheres.sphere_cover import MOST, check_cover_settings

from .arguments import (
    add_cache_options,
    add_model_options,
    add_set_option,
    check_assigned_units,
    load_model,
    manage_cache,
    needs_mujoco,
    parse_assignments,
    parse_length,
    require,
)
from .output import colorize, format_cells, join_lines, show_activity, show_progress
from .pages import add_page_options, check_picture_path, handle_interrupts, page_options, print_address

if TYPE_CHECKING:
    import kineverse as kv
    from kineverse.geometry.objects import CollisionObject
    from kineverse.planning.spheres import SphereCover

HELP = """\
Every point of a shape lies in a sphere; the shapes of a link are covered together. Meshes are covered as the
convex hulls that distances are computed to. The spheres are stored in the user's cache by the content of the
shapes and the settings.

"protrusion" is the largest distance of a sphere's points from the shapes. By default spheres stick out by a
tenth of the size of a link, from 5 mm to 25 mm, or by more where 48 spheres are not enough for that.

The exit status is 0 if all went well, 1 if a link could not be covered.

examples:
  kineverse spheres fetch
  kineverse spheres robot.urdf --links gripper palm --protrusion 5mm --most 64
  kineverse spheres fetch --view
  kineverse spheres --list"""

WRONG_SHAPE = 1


@dataclass
class LinkCover:
    """Cover of the shapes of a link."""

    link: str
    items: Sequence[CollisionObject]  # shapes
    cover: SphereCover | None = None  # their cover, in the frame of the link; None if there is none
    error: str = ""  # why there is none
    seconds: float = 0.0  # computation time [s]; 0 for a cover that was cached


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    # An option that takes several words would take MODEL as well.
    parser.usage = "%(prog)s [MODEL] [options]"
    parser.add_argument("model", metavar="MODEL", nargs="?", help="name or path of a model; it comes first")
    add_model_options(parser)
    parser.add_argument(
        "--links", metavar="LINK", nargs="+", help="only the shapes of these links (or patterns)"
    )
    parser.add_argument("--protrusion", metavar="M", help="how far spheres may stick out: 0.005, 5mm")
    parser.add_argument("--most", metavar="N", type=int, help="largest number of spheres of a link (48)")
    parser.add_argument("--decomposed", action="store_true", help="cover the hulls of kineverse decompose")
    add_cache_options(parser, "compute cached covers again")
    parser.add_argument("--view", action="store_true", help="show model and spheres in the browser")
    parser.add_argument("--picture", metavar="PATH", help="write a picture (.png) of model and spheres")
    add_set_option(parser)
    add_page_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Cover the shapes, print the results, show them if wanted, and return the status."""
    if arguments.list or arguments.clear:
        return _manage_cache(arguments)
    if arguments.model is None:
        raise UnknownNameError("Name a model, before --links; see kineverse spheres --help.")
    require("kineverse spheres", {"geometry": True, "mjcf": needs_mujoco(arguments.model)})

    protrusion = None if arguments.protrusion is None else parse_length(arguments.protrusion)
    most = MOST if arguments.most is None else arguments.most
    check_cover_settings(protrusion, most)
    state = parse_assignments(arguments.assignments)
    check_picture_path(arguments.picture)
    with show_activity(f"reading {arguments.model}"):
        model = load_model(arguments, arguments.model)
    for name in state:
        model.symbol(name)  # raises for unknown names, with similar ones
    check_assigned_units(model, arguments.assignments, "--set")
    links = [LinkCover(body, items) for body, items in _objects(model, arguments).items()]
    for link in show_progress(links, "covering", "link"):
        _cover(link, protrusion, most, arguments.force)
    status = WRONG_SHAPE if any(link.error for link in links) else 0
    if arguments.json:
        print(json.dumps(_to_json(links, status), allow_nan=False))
    else:
        print("\n\n".join(_format_links(links)), flush=True)
    if arguments.picture is not None:
        from kineverse.view.pictures import save_picture  # for start-up time

        save_picture(arguments.picture, model, state, overlay=list(_drawables(links)))
        print(f"picture: {arguments.picture}", file=sys.stderr)
    if arguments.view:
        _view(arguments, model, state, links)
    return status


def _objects(model: kv.Model, arguments: argparse.Namespace) -> dict[str, Sequence[CollisionObject]]:
    import_coal()
    source = CollisionObjects((), ("*",) if arguments.decomposed else (), ())
    source.synchronize(model)
    if not source.by_body:
        raise InvalidValueError(f"{arguments.model} has no shapes that spheres could cover.")
    with_shapes = {body: items for body, items in source.by_body.items() if items}
    wanted = match_names(arguments.links or "*", with_shapes, "link with shapes", "--links")
    return {body: items for body, items in with_shapes.items() if body in wanted}


def _cover(link: LinkCover, protrusion: float | None, most: int, force: bool) -> None:
    """Add the cover of a link, or the reason why there is none."""
    try:
        cached = not force and are_covered(link.items, protrusion, most)
        begin = time.perf_counter()
        cover = cover_objects(link.items, protrusion, most, force=force)
        link.seconds = 0.0 if cached else time.perf_counter() - begin
        link.cover = cover.move(link.items[0].shape.origin.matrix)
    except KineverseError as error:
        link.error = join_lines(error)


HEAD = ("link", "shapes", "spheres", "protrusion [mm]", "time")


def _format_links(links: Sequence[LinkCover]) -> list[str]:
    covered = [(link, link.cover) for link in links if link.cover is not None]
    rows = [_format_row(link.link, [(link, cover)]) for link, cover in covered]
    if len(rows) > 1:
        rows.append(_format_row("total", covered))
    sections = [format_cells(HEAD, rows)] if rows else []
    errors = [f"  {link.error}" for link in links if link.error]
    return sections + (["\n".join([colorize("not covered", "!"), *errors])] if errors else [])


def _format_row(name: str, links: Sequence[tuple[LinkCover, SphereCover]]) -> tuple[str, ...]:
    seconds = sum(link.seconds for link, _ in links)
    return (
        name,
        str(sum(len(link.items) for link, _ in links)),
        str(sum(len(cover) for _, cover in links)),
        format_number(1e3 * max(cover.protrusion for _, cover in links), 3),
        f"{seconds:.1f} s" if seconds else "cached",
    )


def _to_json(links: Iterable[LinkCover], status: int) -> dict[str, Any]:
    answers = []
    for one in links:
        facts = {"link": one.link, "shapes": len(one.items), "seconds": one.seconds, "error": one.error}
        if one.cover is not None:
            facts["protrusion"] = one.cover.protrusion
            facts |= {"centres": one.cover.centres.tolist(), "radii": one.cover.radii.tolist()}
        answers.append(facts)
    return {"status": status, "links": answers}


def _drawables(links: Iterable[LinkCover]) -> Iterator[Any]:
    from kineverse.view.drawables import draw_cover  # for start-up time

    return (draw_cover(link.link, link.cover) for link in links if link.cover is not None)


def _view(
    arguments: argparse.Namespace, model: kv.Model, state: dict[str, float], links: Iterable[LinkCover]
) -> None:
    from kineverse.view.page import read_title  # for start-up time
    from kineverse.view.viewer import Viewer  # for start-up time

    label = read_title(arguments.model)
    with handle_interrupts(), Viewer(model, state, label=label, **page_options(arguments)) as page:
        page.show_overlay(_drawables(links))
        print_address(page, browser=not arguments.no_browser)
        page.wait()


def _manage_cache(arguments: argparse.Namespace) -> int:
    def describe(one: CachedCover) -> tuple[dict[str, Any], tuple[str, ...]]:
        spheres, protrusion = len(one.cover), one.cover.protrusion
        facts = {"name": one.name, "spheres": spheres, "protrusion": protrusion, "bytes": one.bytes}
        return facts, (one.name, str(spheres), format_number(1e3 * protrusion, 3))

    head, entries = ("shape", "spheres", "protrusion [mm]"), [*map(describe, list_covers())]
    return manage_cache(arguments, arguments.model, "covers", cover_folder(), clear_covers, head, entries)
