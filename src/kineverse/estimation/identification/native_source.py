"""The C text of identification, put together."""

from .native_algebra import ALGEBRA
from .native_evidence import EVIDENCE
from .native_look import LOOK
from .native_mirrored import MIRRORED
from .native_settling import SETTLE
from .native_sliding import SLIDING
from .native_stages import STAGES
from .native_step import STEP
from .native_widening import WIDEN
from .native_widths import WIDTHS

SOURCE = ALGEBRA + LOOK + WIDEN + STEP + SETTLE + WIDTHS + SLIDING + MIRRORED + EVIDENCE + STAGES
