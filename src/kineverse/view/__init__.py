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

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .camera import Camera as Camera
    from .finding_pictures import draw_finding as draw_finding
    from .page import show as show, view as view
    from .pictures import picture as picture, save_picture as save_picture

lazy_face(__name__)
