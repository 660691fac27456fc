"""Models in notebooks: the page below a cell, with a picture where the page cannot be.

A page ends with its kernel, and a browser elsewhere does not reach it, but a saved notebook is read anywhere.
So each display has a picture. It is the content of the element ``object`` that embeds the page: browsers show
it when the page does not answer, without a script, and readers that drop such elements keep it.
"""

from __future__ import annotations

import logging
import sys
from base64 import b64encode
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from kineverse._rich_display import Html, element, join_html, picture_element
from kineverse.errors import KineverseError
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike

from .pictures import encode_png, picture
from .poses import complete, keep_known
from .rendering.camera import Camera

logger = logging.getLogger(__name__)

HEIGHT = 600  # height of the page in a notebook [pixels]: it fills a cell, and the cell's code is still seen
SIZE = (
    480,
    360,
)  # size of the picture [pixels]: drawn in about a second, and 30 to 60 kB of a saved notebook


def find_shell() -> Any:
    """Return the shell of IPython in this process, None if there is none."""
    ipython = sys.modules.get("IPython")
    return None if ipython is None else ipython.get_ipython()


def is_in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook, whose front end shows results as HTML."""
    return getattr(find_shell(), "kernel", None) is not None


def bundle_display(
    plain: str,
    model: ModelView,
    values: Mapping[str, float],
    camera: Camera | None = None,
    *,
    address: str = "",
    note: str = "",
) -> dict[str, str]:
    """Return the display of a model by MIME type: HTML with its page, its picture, and a plain text.

    The address of the page is empty if there is none; the note is a line above the picture.
    """
    bundle = {"text/plain": plain}
    shown = Html()
    try:
        png = encode_png(picture(model, values, SIZE, camera))
    except KineverseError as error:  # The page says why this state cannot be shown.
        logger.info("there is no picture of this state: %s", error)
    else:
        bundle["image/png"] = b64encode(png).decode()
        shown = picture_element(png, str(model))
    if note:
        shown = join_html(element("p", note), shown)
    if address:
        shown = element(
            "object", shown, data=address, type="text/html", width="100%", height=HEIGHT, style="border:none"
        )
    bundle["text/html"] = str(shown)
    return bundle


class ModelPicture:
    """Picture of a model as the result of a cell: what :func:`.show` returns in a notebook without viser.

    It follows the edits of its model: each display draws the present one.
    """

    def __init__(
        self,
        model: ModelView,
        state: StateLike | None = None,
        *,
        camera: Camera | None = None,
        note: str = "",
    ) -> None:
        self.model = model
        self.values: dict[str, float] = dict(complete(model, state))
        self._camera, self._note = camera, note

    def move(self, values: StateLike) -> None:
        """Set the values of some symbols, by symbol or name [m], [rad], for the next display."""
        given = {str(symbol): value for symbol, value in values.items()}
        self.values = dict(complete(self.model, {**keep_known(self.model, self.values), **given}))

    def stop(self) -> None:
        """Do nothing: there is no page to take down."""

    def __enter__(self) -> ModelPicture:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def __repr__(self) -> str:
        return f"<picture of {self.model!r}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        values = complete(self.model, keep_known(self.model, self.values))
        return bundle_display(repr(self), self.model, values, self._camera, note=self._note)
