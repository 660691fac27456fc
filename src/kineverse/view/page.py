"""Show a model on a web page from Python, and choose the title of the page."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

from kineverse.errors import KineverseError, MissingDependencyError
from kineverse.formats.files import read_file
from kineverse.formats.locate import locate_model
from kineverse.formats.xml_reader import Element, Visit, parse_xml
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike

if TYPE_CHECKING:
    from .notebook import ModelPicture  # for start-up time
    from .rendering.camera import Camera
    from .viewer import Viewer


def show(
    model: ModelView,
    state: StateLike | None = None,
    *,
    block: bool | None = None,
    open_browser: bool = True,
    port: int | None = None,
    host: str = "127.0.0.1",
    label: str | None = None,
    camera: Camera | None = None,
    degrees: bool = False,
) -> Viewer | ModelPicture:
    """Show a model on a web page, with a slider for each degree of freedom.

    In a script this opens the browser and blocks until Ctrl-C; then the page is taken down and the script
    goes on. Closing the page in the browser changes nothing. At a prompt it returns at once. So it does in a
    notebook, in which the result of a cell is the page itself, with a picture where the page is not reached.
    The address of the page is written to standard error, except in a notebook.

    Parameters
    ----------
    model
        The model. The page follows its edits.
    state
        Values by symbol or name [m], [rad]; the default state for the others.
    block
        True to wait for Ctrl-C; None to wait in scripts only.
    open_browser
        True to open the page in the browser, if there is a screen and this is no notebook.
    port
        The port, 0 for any free one; None for 8080 or any free one.
    host
        The address to listen on: this computer alone, unless another one is given. Then the address of the
        page includes a random token, and everybody who has it may look and move.
    label
        The title of the page; None for the names in front of all frames.
    camera
        The initial camera; None for one that shows all of the model, and as much as possible of its moving
        parts.
    degrees
        True to show angles in degrees at first.

    Returns
    -------
    The page, up unless this has waited: ``move``, ``play`` and ``stop`` are among its methods. In a notebook
    without viser, a picture, which has ``move`` and ``stop`` only.

    Raises
    ------
    MissingDependencyError
        If viser is not installed, and this is no notebook.
    InvalidValueError
        If the model is none, the port is taken or no port, or the host is not one of this computer.

    Examples
    --------
    >>> page = kv.show(kv.load("kitchen"), block=False, open_browser=False, port=0)
    >>> page.move({"kitchen/fridge_door": 0.8})
    >>> page.stop()
    """
    from .notebook import ModelPicture, find_shell, is_in_notebook  # for start-up time
    from .viewer import Viewer

    notebook = is_in_notebook()
    # At a prompt, and in a script that ends in one, nothing waits.
    prompt = hasattr(sys, "ps1") or bool(sys.flags.interactive) or find_shell() is not None
    waits = not prompt if block is None else block
    try:
        page = Viewer(model, state, port=port, host=host, label=label, camera=camera, degrees=degrees)
    except MissingDependencyError as error:
        if not notebook:
            raise
        return ModelPicture(model, state, camera=camera, note=str(error))
    try:
        if not notebook:
            print(
                f"{page.address}   ({'Ctrl-C' if waits else 'page.stop()'} ends)", file=sys.stderr, flush=True
            )
            if open_browser:
                open_page(page.address)
        if waits:
            page.wait()
    except BaseException as error:
        page.stop()
        if not (waits and isinstance(error, KeyboardInterrupt)):
            raise
        print(file=sys.stderr)  # the terminal has written ^C on this line
    return page


def view(
    model: ModelView,
    state: StateLike | None = None,
    *,
    port: int | None = None,
    label: str | None = None,
    camera: Camera | None = None,
    host: str = "127.0.0.1",
    degrees: bool = False,
) -> Viewer:
    """Show a model on a web page and return at once; :func:`kineverse.show` waits, and opens the browser.

    Parameters, result and errors are those of :class:`kineverse.view.viewer.Viewer`.

    Examples
    --------
    >>> with kv.view.view(kv.load("kitchen"), port=0) as page:
    ...     page.move({"kitchen/fridge_door": 0.8})
    ...     "http" in page.address
    True
    """
    from .viewer import Viewer  # for start-up time

    return Viewer(model, state, port=port, label=label, camera=camera, host=host, degrees=degrees)


def open_page(address: str) -> None:
    """Open an address in the browser, if there is a screen."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    if sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in screens):
        import webbrowser  # for start-up time

        webbrowser.open(address)


UNNAMED = "Kineverse"

MOST = 3  # most names in a title of several models
LONGEST = 60  # most characters of one of them
SUFFIXES = (".urdf", ".xml", ".mjcf", ".sdf", ".world")  # suffixes of files that declare the name of a model

NAMED_BY = {"robot": "name", "mujoco": "model", "model": "name", "world": "name"}
"""The attributes of elements of URDF, MJCF and SDF that declare the name of a model."""


class _NamedError(Exception):
    """End of reading a file, raised once its name is known."""


def choose_title(model: ModelView) -> str:
    """Return the prefixes of all frames, such as ``kitchen, pr2``, or ``Kineverse``."""
    frames = [name for name in model.frames if name != WORLD]
    prefixes = list(dict.fromkeys(name.partition("/")[0] for name in frames))
    if not frames or not all("/" in name for name in frames):
        return UNNAMED
    return ", ".join(map(_shorten, prefixes[:MOST])) + (" …" if len(prefixes) > MOST else "")


def read_title(source: str) -> str:
    """Return the name of a model that its file declares, or the name of the file."""
    plain = os.path.basename(source.rstrip("/"))
    try:
        found = locate_model(source)
        if found.shipped or not found.path.name.endswith(SUFFIXES):
            return plain
        return _shorten(_read_declared_name(read_file(found.path), plain) or plain)
    except KineverseError:
        return plain


def _read_declared_name(content: bytes, source: str) -> str:
    """Return the name of a model that an XML document declares, empty if it declares none."""
    names: list[str] = []

    def note(element: Element) -> None:
        tag, attributes, _, _ = element
        names.extend(filter(None, [attributes.get(NAMED_BY.get(tag, ""), "").strip()]))
        if names or tag != "sdf":
            raise _NamedError

    def begin(root: Element) -> Visit:
        note(root)
        return note

    with suppress(_NamedError):
        parse_xml(content, source, begin=begin)
    return names[0] if names else ""


def _shorten(name: str) -> str:
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"
