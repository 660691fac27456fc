"""Layer 2: expressions to fast functions."""

from .evaluator import Evaluator
from .function import CompiledFunction, compile  # noqa: A004 - the name the design gives it
from .information import CompilerInformation, compiler_information

__all__ = ["CompiledFunction", "CompilerInformation", "Evaluator", "compile", "compiler_information"]
