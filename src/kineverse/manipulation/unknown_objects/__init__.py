"""Parts with an unknown joint: the hand pulls, the joint is learned, and written into the model."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .unknown_opening import open_unknown as open_unknown
    from .unmodelled_joint import forget_joint as forget_joint

lazy_face(__name__)
