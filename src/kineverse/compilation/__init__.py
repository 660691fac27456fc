"""Compilation of expressions to fast functions."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .c_library import (
        CompilerInformation as CompilerInformation,
        compiler_information as compiler_information,
    )
    from .evaluator import Evaluator as Evaluator
    from .function import CompiledFunction as CompiledFunction, compile as compile

lazy_face(__name__)
