"""Compilation of expressions to fast functions."""

from .c_library import CompilerInformation, compiler_information
from .evaluator import Evaluator
from .function import CompiledFunction, compile

__all__ = ["CompiledFunction", "CompilerInformation", "Evaluator", "compile", "compiler_information"]
