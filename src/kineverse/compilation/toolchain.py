"""C compiler of this machine: detection, flags and identity.

Compiled libraries are stored on disk, which other machines may share (a home directory on a network) and
where they outlive an update of the compiler. So :attr:`Toolchain.identity` covers everything that generated
code depends on. It is read from files, because it is needed whenever a function is compiled, and starting a
compiler takes far longer.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence

from msgspec import Struct

logger = logging.getLogger("kineverse.compile.toolchain")

# Flags with which C and interpreter agree to the last bit. No -ffast-math, which also deletes checks for NaN;
# no contraction to fused operations; no constant folding of functions by the compiler (-frounding-math),
# which rounds them better than the C library.
FLOATING_POINT_FLAGS = ("-march=native", "-ffp-contract=off", "-fno-math-errno", "-frounding-math")
NO_COMPILER = (
    "there is no C compiler (cc, gcc or clang) on the PATH. Install one, such as by 'apt install gcc'"
)
"""Reason, and remedy."""

# Undefined names fail when a library is linked and not when a function is called.
NO_UNDEFINED_FLAGS = ("-Wl,-z,defs",) if sys.platform.startswith("linux") else ()

_CPU_LINES = (
    "vendor_id", "cpu family", "model", "stepping", "flags",
    "CPU implementer", "CPU architecture", "CPU variant", "CPU part", "Features",
)  # fmt: skip


class Toolchain(Struct, frozen=True):
    """A C compiler."""

    command: tuple[str, ...]  # absolute path of the compiler, and its constant arguments
    identity: str  # digest of compiler, processor and platform

    def arguments(self, flags: Sequence[str], output: str) -> list[str]:
        """Return the command line that compiles C from standard input to a shared library."""
        always = ("-std=gnu11", "-fPIC", "-shared", "-fvisibility=hidden", "-w")
        return [*self.command, *FLOATING_POINT_FLAGS, *always, *flags, "-x", "c", "-", "-o", output, "-lm"]

    def version(self) -> str:
        """Return the first line of the compiler's version text."""
        return (self._ask("--version").splitlines() or ["unknown"])[0]

    def vector_unit(self) -> str:
        """Return the widest vector instructions for doubles: avx512, avx2, avx, sse2, neon or none."""
        macros = self._ask(*FLOATING_POINT_FLAGS, "-dM", "-E", "-x", "c", os.devnull)
        units = {
            "__AVX512DQ__": "avx512",
            "__AVX2__": "avx2",
            "__AVX__": "avx",
            "__SSE2__": "sse2",
            "__ARM_NEON": "neon",
        }
        return next((unit for macro, unit in units.items() if f" {macro} " in macros), "none")

    def _ask(self, *arguments: str) -> str:
        try:
            answer = subprocess.run(
                [*self.command, *arguments],
                capture_output=True,
                encoding="utf-8",
                errors="replace",
                timeout=20,
                stdin=subprocess.DEVNULL,
            )
        except (OSError, subprocess.TimeoutExpired):
            return ""
        return answer.stdout


def toolchain() -> Toolchain | None:
    """Return the compiler named by ``CC``, else ``cc``, ``gcc`` or ``clang``.

    None if there is none, which is logged once.
    """
    return _find(os.environ.get("CC", ""), os.environ.get("PATH", os.defpath))


def optimisation_level(instructions: int) -> str | None:
    """Return the optimisation flag for a program of some size; None if it is too large for a compiler.

    gcc 12 takes 0.2 ms an instruction at -O3, 0.12 ms at -O1 (7 % slower code) and 0.06 ms at -O0 (three
    times slower, and four times faster than the interpreter).
    """
    if instructions <= 8_000:
        return "-O3"
    if instructions <= 60_000:
        return "-O1"
    if instructions <= 400_000:
        return "-O0"
    return None


def vector_optimisation_level(instructions: int) -> str | None:
    """Return the optimisation flag for a program of vectors; None if it is too large for a compiler.

    Such programs are split into C functions, so time is proportional to length. gcc 12 takes 0.13 ms an
    instruction at -O2 and 0.09 ms at -O1 (5 % slower code). -O3 is as -O2, and at -O0 compilation takes twice
    and the code 20 times as long.
    """
    if instructions <= 60_000:
        return "-O2"
    if instructions <= 400_000:
        return "-O1"
    return None


@functools.lru_cache(maxsize=16)
def _find(preferred: str, path: str) -> Toolchain | None:
    for candidate in (preferred, "cc", "gcc", "clang"):
        try:
            words = shlex.split(candidate)
        except ValueError as error:
            logger.warning("CC is %r, which is no command (%s), and is ignored.", candidate, error)
            continue
        found = shutil.which(words[0], path=path) if words else None
        if found:
            command = (os.path.abspath(found), *words[1:])
            return Toolchain(command, _identity(command))
    logger.warning("No C compiler (cc, gcc, clang) was found: functions stay with CasADi's interpreter.")
    return None


def _identity(command: tuple[str, ...]) -> str:
    program = os.path.realpath(command[0])
    file = os.stat(program)
    compiler = (program, file.st_size, file.st_mtime_ns, command[1:], FLOATING_POINT_FLAGS)
    parts = (compiler, platform.system(), platform.machine(), _cpu())
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def _cpu() -> str:
    """Return the description of the processor that determines its instructions."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            # One processor is enough, and the kernel generates the text of the others only when it is read.
            lines = file.read(8192).split("\n\n", 1)[0].splitlines()
    except OSError:
        return platform.processor()
    return "\n".join(line for line in lines if line.split("\t", 1)[0].rstrip(" :") in _CPU_LINES)
