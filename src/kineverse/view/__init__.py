"""Looking at models: a page in the browser, and pictures without one.

>>> import kineverse as kv
>>> from kineverse.view import picture, save, view
>>> pixels = picture(kv.load("kitchen"), {"kitchen/fridge_door": 0.8})    # needs numpy only
>>> save("kitchen.png", kv.load("kitchen"))
>>> with view(kv.load("kitchen")) as page:                                # needs the extra "view"
...     print(page.address)

Pictures are drawn by numpy; the page is served by viser to this computer alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from kineverse.view.camera import Camera
from kineverse.view.drawing import picture, save

if TYPE_CHECKING:
    from kineverse.model.view import ModelView
    from kineverse.view.viewer import Viewer

__all__ = ["Camera", "picture", "save", "view"]


def view(
    model: ModelView,
    state: Mapping[Any, float] | None = None,
    *,
    port: int | None = None,
    label: str = "Kineverse",
    camera: Camera | None = None,
) -> Viewer:
    """Show a model on a web page of this computer; see :class:`kineverse.view.viewer.Viewer`."""
    from kineverse.view.viewer import Viewer

    return Viewer(model, state, port=port, label=label, camera=camera)
