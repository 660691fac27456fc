"""A fuzzer for the readers of descriptions and documents: ``make fuzz ARGS="--target sdf --minutes 60"``.

Inputs come from grammars, from mutations of trees and of bytes, and from a corpus of inputs that reached new
code, which atheris measures (libFuzzer for Python). For each input, the invariants of :mod:`.invariants` have
to hold. A format is a :class:`.targets.Target`.
"""
