"""Viewer of models: a page in the browser, and pictures without one.

>>> import kineverse as kv
>>> from kineverse.view import picture, save_picture, view
>>> pixels = picture(kv.load("kitchen"), {"kitchen/fridge_door": 0.8})    # needs numpy only
>>> save_picture("kitchen.png", kv.load("kitchen"))
>>> with view(kv.load("kitchen")) as page:                                # needs the extra "view"
...     print(page.address)
>>> kv.show(kv.load("kitchen"))                                           # the same, until Ctrl-C

Pictures are drawn by numpy. The page is served by viser, to this computer alone unless a host is given.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from kineverse.state import StateLike

from .camera import Camera
from .page import show
from .pictures import picture, save_picture

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView

    from .viewer import Viewer

__all__ = ["Camera", "picture", "save_picture", "show", "view"]


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
    """
    from .viewer import Viewer

    return Viewer(model, state, port=port, label=label, camera=camera, host=host, degrees=degrees)
