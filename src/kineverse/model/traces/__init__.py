"""Traces: what an operation computes, as expressions of what it read.

An operation is code, and code does not travel. Its trace does: the questions it asked of the model, and its
writes as expressions of the answers. Whoever has the trace can run the operation again on other answers,
without its class.
"""

from .answer import Answer
from .question import Look, Question
from .trace import Step, Trace, UntraceableError
from .tracing import trace

__all__ = ["Answer", "Look", "Question", "Step", "Trace", "UntraceableError", "trace"]
