"""Traces of operations: writes as expressions of the values read.

Documents contain no code of operations. They contain traces instead: the queries of an operation to the
model, and its writes as expressions of the results. A trace can be evaluated on another model without the
class.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .recorder import record_trace as record_trace
    from .trace import (
        ReadNode as ReadNode,
        Trace as Trace,
        TraceStep as TraceStep,
        UntraceableError as UntraceableError,
    )
    from .trace_queries import Access as Access, Query as Query

lazy_face(__name__)
