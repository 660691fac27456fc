"""``import``: importing the library in a fresh process, and the packages that takes."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata

from .peers import Field, advice, installed
from .processes import run_program
from .result import Bar, Comparison, Measurement, Result, at_most, faster
from .settings import Settings
from .timing import Contender, race

KINEVERSE = "import kineverse"
PEERS = ("casadi", "pinocchio", "mujoco")
CORE, MOST_PACKAGES = "kineverse-articulation", 14


def measure(settings: Settings) -> Result:
    """Measure imports, and count packages."""
    field = Field([_import("kineverse")])
    for peer in PEERS:
        field.admit(peer, lambda peer=peer: [_import(peer)])  # type: ignore[misc]
    measured = race("import", field.contenders, settings.processes, settings.progress)
    comparisons = [at_most(measured[KINEVERSE], 0.5)]
    comparisons += [faster(measured, KINEVERSE, f"import {peer}") for peer in PEERS]
    packages = []
    if installed("packaging"):
        packages = list(_packages())
        bar = Bar(MOST_PACKAGES, at_least=False)
        comparisons.append(Comparison(packages[0].name, packages[0].median, "packages", bar))
    else:
        field.missing.append(advice("packaging"))
    return Result(
        name="import",
        work="the import, in a fresh process; and the packages that pip installs for it, itself included",
        measurements=(*measured.values(), *packages),
        comparisons=tuple(comparisons),
        missing=tuple(field.missing),
    )


def _import(module: str) -> Contender:
    return Contender(f"import {module}", lambda: float(run_program("import_time", module)["seconds"]))


def _packages() -> Iterator[Measurement]:
    for distribution in (CORE, "pin", "mujoco"):
        try:
            count = len(closure(distribution))
        except metadata.PackageNotFoundError:
            continue
        yield Measurement(f"packages for {distribution}", "packages", (float(count),))


def closure(distribution: str) -> set[str]:
    """Return a distribution and all that it requires here, without extras that nobody asks for.

    Raises
    ------
    importlib.metadata.PackageNotFoundError
        If one of them is not installed.
    """
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    found: set[str] = set()
    waiting = [Requirement(distribution)]
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        if name in found:
            continue
        found.add(name)
        extras = wanted.extras or {""}
        for text in metadata.requires(name) or ():
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
                waiting.append(requirement)
    return found
