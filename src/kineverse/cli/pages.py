"""Pages and pictures of commands: options, address, interrupts, files that can be written, missing meshes."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView


def add_page_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a command that opens a page."""
    parser.add_argument("--port", type=int, metavar="N", help="port of the page (8080, or any free one)")
    parser.add_argument(
        "--host", metavar="ADDRESS", help="serve other computers: listen on this address (0.0.0.0: all)"
    )
    parser.add_argument("--no-browser", action="store_true", help="only print the address")


def page_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the page options as keyword arguments of a page."""
    return {"port": arguments.port, **({"host": arguments.host} if arguments.host else {})}


def print_address(page: Any, browser: bool) -> None:
    """Print the address of a page, and open it if there is a display."""
    print(f"{page.address}   (Ctrl-C ends)", flush=True)
    if browser:
        from kineverse.view.page import open_page  # for start-up time

        open_page(page.address)


@contextmanager
def handle_interrupts() -> Iterator[None]:
    """Leave the context on Ctrl-C or SIGTERM, without an exception."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        print(file=sys.stderr)
    finally:
        signal.signal(signal.SIGTERM, before)


def list_mesh_problems(model: ModelView) -> list[str]:
    """Return a line for each visual mesh that cannot be read."""
    from kineverse.view import meshes  # for start-up time

    loaded = {mesh.uri: meshes.load_mesh(mesh) for mesh in meshes.list_visual_meshes(model)}
    return [f"{uri}: {mesh.problem}" for uri, mesh in loaded.items() if mesh.problem]


def print_mesh_problems(problems: list[str]) -> None:
    """Print a line on standard error if meshes are missing."""
    if problems:
        more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
        print(f"kineverse: shown as placeholders: {problems[0]}{more}", file=sys.stderr)


def check_picture_path(path: str | None, clips: bool = False) -> None:
    """Raise unless a picture can be written, before the work; None stands for no picture.

    ``clips`` says whether the picture may be a clip.
    """
    if path is None:
        return
    from kineverse.view.clips import is_clip_name  # for start-up time
    from kineverse.view.pictures import check_png_name  # for start-up time

    if not (clips and is_clip_name(path)):
        check_png_name(path)
    check_file_path(path)


def check_recording_path(path: str | None) -> None:
    """Raise unless a recording can be written, before the work; None stands for no recording."""
    if path is None:
        return
    from kineverse.worlds.recorder import check_recording_name  # for start-up time

    check_recording_name(path)
    check_file_path(path)


def check_file_path(path: str) -> None:
    """Raise OSError unless a file can be written, without leaving an empty one if the run is interrupted."""
    new = not os.path.lexists(path)
    open(path, "ab").close()
    if new:
        os.remove(path)
