"""Viewer of models: a page in the browser, and pictures without one.

>>> import kineverse as kv
>>> pixels = kv.view.picture(kv.load("shelf_door"), {"shelf_door/door": 0.8})
>>> kv.view.save_picture("shelf.png", kv.load("shelf_door"))

:func:`kineverse.show` opens a page in the browser and waits; :func:`view` does neither.
Pictures are drawn by numpy. The page is served by viser, to this computer alone unless a host is given.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .rendering.camera import Camera as Camera
    from .finding_pictures import draw_finding as draw_finding
    from .page import show as show, view as view
    from .pictures import picture as picture, save_picture as save_picture

lazy_face(__name__)
