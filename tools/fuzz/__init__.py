"""A fuzzer for the readers of descriptions and documents: ``make fuzz ARGS="--target sdf --minutes 60"``.

Inputs come from grammars, from mutations of trees and of bytes, and from what reached new code before, which
atheris watches (libFuzzer for Python). For each of them the law of :mod:`.law` has to hold. A format is a
:class:`.targets.Target`.
"""
