"""C compiler of this machine: detection, flags and identity.

Compiled libraries are stored on disk, which other machines may share (a home directory on a network) and
where they outlive an update of the compiler. So :attr:`Toolchain.identity` covers everything that generated
code depends on. It is read from files, because it is needed whenever a function is compiled, and starting a
compiler takes far longer.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence

from msgspec import Struct

from kineverse._extras import install_command

logger = logging.getLogger("kineverse.compile.toolchain")

# Flags with which C and interpreter agree to the last bit. No -ffast-math, which also deletes checks for NaN;
# no contraction to fused operations; no constant folding of functions by the compiler (-frounding-math),
# which rounds them better than the C library.
FLOATING_POINT_FLAGS = ("-march=native", "-ffp-contract=off", "-fno-math-errno", "-frounding-math")
# Undefined names fail when a library is linked and not when a function is called.
NO_UNDEFINED_FLAGS = ("-Wl,-z,defs",) if sys.platform.startswith("linux") else ()

# Of zig, without debugging information, which makes libraries larger by half and more, and without checks for
# undefined behaviour, which zig adds to code that is not optimised.
_ZIG_FLAGS = ("-g0", "-s", "-fno-sanitize=undefined")
_ZIG_FOLDERS = ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")

_CPU_LINES = (
    "vendor_id", "cpu family", "model", "stepping", "flags",
    "CPU implementer", "CPU architecture", "CPU variant", "CPU part", "Features",
)  # fmt: skip


class Toolchain(Struct, frozen=True):
    """A C compiler."""

    command: tuple[str, ...]  # absolute path of the compiler, and its constant arguments
    identity: str  # digest of compiler, processor and platform

    @property
    def is_zig(self) -> bool:
        """True for zig, which spells some flags otherwise and keeps files of its own."""
        return _is_zig(self.command)

    def arguments(self, flags: Sequence[str], output: str) -> list[str]:
        """Return the command line that compiles C from standard input to a shared library."""
        always = ("-std=gnu11", "-fPIC", "-shared", "-fvisibility=hidden", "-w")
        return [*self.command, *FLOATING_POINT_FLAGS, *always, *flags, "-x", "c", "-", "-o", output, "-lm"]

    def environment(self, folder: str) -> dict[str, str]:
        """Return the environment variables for the compiler, whose temporary files are put in a folder."""
        own = _zig_folders(folder) if self.is_zig else {}
        return {**os.environ, **own, "TMPDIR": folder, "LC_ALL": "C"}

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
        import tempfile  # for start-up time

        try:
            with tempfile.TemporaryDirectory(prefix="kineverse-") as folder:
                answer = subprocess.run(
                    [*self.command, *arguments],
                    capture_output=True,
                    encoding="utf-8",
                    errors="replace",
                    timeout=20,
                    stdin=subprocess.DEVNULL,
                    env={**os.environ, **dict.fromkeys(_ZIG_FOLDERS, folder)},
                )
        except (OSError, subprocess.TimeoutExpired):
            return ""
        return answer.stdout


def toolchain() -> Toolchain | None:
    """Return the compiler named by ``CC``, else ``cc``, ``gcc``, ``clang``, or zig of the package ziglang.

    None if there is none, which is logged once.
    """
    return _find(os.environ.get("CC", ""), os.environ.get("PATH", os.defpath))


def no_compiler() -> str:
    """Return the reason why nothing can be compiled without a compiler, and the remedies."""
    return (
        "there is no C compiler (cc, gcc or clang) on the PATH. Install one, such as by 'apt install gcc', "
        f"or the extra 'compiler' (ziglang, 411 MB): {install_command('compiler')}"
    )


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
    for words in _candidates(preferred):
        found = shutil.which(words[0], path=path)
        if found:
            command = (os.path.abspath(found), *words[1:])
            if _is_zig(command):
                command += _ZIG_FLAGS
            return Toolchain(command, _identity(command, path))
    logger.warning("Functions stay with CasADi's interpreter: %s.", no_compiler())
    return None


def _candidates(preferred: str) -> Iterator[list[str]]:
    """Yield the command lines of compilers that may exist, the best one first."""
    try:
        words = shlex.split(preferred)
    except ValueError as error:
        logger.warning("CC is %r, which is no command (%s), and is ignored.", preferred, error)
    else:
        if words:
            yield words
    yield from (["cc"], ["gcc"], ["clang"])
    # The program itself, not the module: an update of the package changes the identity.
    package = importlib.util.find_spec("ziglang")
    for folder in (package and package.submodule_search_locations) or ():
        yield [os.path.join(folder, "zig.exe" if os.name == "nt" else "zig"), "cc"]


def _is_zig(command: Sequence[str]) -> bool:
    """Return True for zig's compiler, be it called by its path or as ``python -m ziglang cc``."""
    return any(os.path.basename(word) in ("zig", "zig.exe", "ziglang") for word in command)


def _zig_folders(folder: str) -> dict[str, str]:
    """Return variables that name zig's folders: one for what it keeps, and the given one for the rest.

    Otherwise both are in the home folder, which need not be writable and where nobody removes them.
    """
    kept = os.environ.get(_ZIG_FOLDERS[0])
    if not kept:
        from .cache import private_subfolder  # for start-up time

        kept = str(private_subfolder("zig").path)
        if not os.listdir(kept):
            _announce_runtime(kept)
    return dict(zip(_ZIG_FOLDERS, (kept, folder), strict=True))


@functools.cache
def _announce_runtime(folder: str) -> None:
    logger.info("The first compilation takes up to 10 s longer: zig builds its runtime, in %s.", folder)


def _identity(command: tuple[str, ...], path: str) -> str:
    # Further words can be programs as well, as in "ccache gcc".
    programs = [os.path.realpath(found) for word in command if (found := shutil.which(word, path=path))]
    files = [(program, (file := os.stat(program)).st_size, file.st_mtime_ns) for program in programs]
    parts = (files, command[1:], FLOATING_POINT_FLAGS, platform.system(), platform.machine(), _cpu())
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
