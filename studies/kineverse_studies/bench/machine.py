"""Machine on which measurements are taken."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from importlib import metadata

from kineverse import position, rotation_z
from kineverse._version import __version__
from kineverse.compile import CompilerInformation, compile, compiler_information  # noqa: A004
from kineverse.compile.call_extension import call_extension

VERSIONS = (
    "casadi",
    "numpy",
    "pin",
    "mujoco",
    "coal",
    "pybullet",
    "daqp",
    "pin-pink",
    "mink",
    "qpsolvers",
    "ompl",
)


@dataclass(frozen=True, slots=True)
class Machine:
    """Machine and software of a run."""

    tier: str
    compiler: CompilerInformation  # C compiler, with the vector unit and the number of cores
    processor: str  # names of processor, operating system and Python implementation, with versions
    system: str
    python: str
    versions: dict[str, str | None]


def describe_machine() -> Machine:
    """Return the machine and software of this process."""
    return Machine(
        tier=_evaluation_tier(),
        compiler=compiler_information(),
        processor=_processor(),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        python=f"{platform.python_implementation()} {platform.python_version()}",
        versions={"kineverse": __version__, **{name: _version(name) for name in VERSIONS}},
    )


def _evaluation_tier() -> str:
    function = compile(rotation_z(position("angle")), wait=True)
    return "c extension" if function.tier == "c" and call_extension.module is not None else function.tier


def _processor() -> str:
    if sys.platform == "linux":
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
