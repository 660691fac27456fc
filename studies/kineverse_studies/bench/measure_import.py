"""``import``: import time in a fresh process, and number of required packages."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata

from .harness import (
    BenchmarkSettings,
    Contender,
    Contenders,
    has_peer,
    install_advice,
    run_program,
    time_contenders,
)
from .result import Bar, BenchmarkResult, Comparison, Measurement, bound_median, compare_speed

KINEVERSE = "import kineverse"
PEERS = ("casadi", "pinocchio", "mujoco")
CORE, MOST_PACKAGES = "kineverse-articulation", 14


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure imports, and count packages."""
    participants = Contenders([_import("kineverse")])
    for peer in PEERS:
        participants.add_peer(peer, lambda peer=peer: [_import(peer)])  # type: ignore[misc]
    measured = time_contenders("import", participants.contenders, settings.processes, settings.progress)
    comparisons = [bound_median(measured[KINEVERSE], 0.5)]
    comparisons += [compare_speed(measured, KINEVERSE, f"import {peer}") for peer in PEERS]
    packages = []
    if has_peer("packaging"):
        packages = list(_packages())
        bar = Bar(MOST_PACKAGES, at_least=False)
        comparisons.append(Comparison(packages[0].name, packages[0].median, "packages", bar))
    else:
        participants.missing.append(install_advice("packaging"))
    return BenchmarkResult(
        name="import",
        work="the import, in a fresh process; and the packages that pip installs for it, itself included",
        measurements=(*measured.values(), *packages),
        comparisons=tuple(comparisons),
        missing=tuple(participants.missing),
    )


def _import(module: str) -> Contender:
    return Contender(f"import {module}", lambda: float(run_program("import_time", module)["seconds"]))


def _packages() -> Iterator[Measurement]:
    for distribution in (CORE, "pin", "mujoco"):
        try:
            count = len(find_requirements(distribution))
        except metadata.PackageNotFoundError:
            continue
        yield Measurement(f"packages for {distribution}", "packages", (float(count),))


def find_requirements(distribution: str) -> set[str]:
    """Return a distribution and all that it requires here, without extras."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    names: set[str] = set()
    pending = [Requirement(distribution)]
    while pending:
        required = pending.pop()
        name = canonicalize_name(required.name)
        if name in names:
            continue
        names.add(name)
        extras = required.extras or {""}
        for text in metadata.requires(name) or ():
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
                pending.append(requirement)
    return names
