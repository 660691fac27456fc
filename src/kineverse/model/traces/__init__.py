"""Traces: what an operation computes, as expressions of what it read.

An operation is code, and code does not travel. Its trace does: the questions it asked of the model, and its
writes as expressions of the answers. Whoever has the trace can run the operation again on other answers,
without its class.
"""

from .placeholder import ReadNode
from .recorder import record_trace
from .trace import Trace, TraceStep, UntraceableError
from .trace_queries import Access, Query

__all__ = ["Access", "Query", "ReadNode", "Trace", "TraceStep", "UntraceableError", "record_trace"]
