"""Traces of operations: writes as expressions of the values read.

Documents contain no code of operations. They contain traces instead: the queries of an operation to the
model, and its writes as expressions of the results. A trace can be evaluated on another model without the
class.
"""

from .recorder import record_trace
from .trace import ReadNode, Trace, TraceStep, UntraceableError
from .trace_queries import Access, Query

__all__ = ["Access", "Query", "ReadNode", "Trace", "TraceStep", "UntraceableError", "record_trace"]
