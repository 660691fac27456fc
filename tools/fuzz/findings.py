"""Findings in a folder: for each signature the smallest input, and its description."""

from __future__ import annotations

import hashlib
from pathlib import Path

from .invariants import Finding


class FindingStore:
    """Folder with the findings of a target."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def add(self, finding: Finding, data: bytes) -> bool:
        """Store an input unless there is a smaller one of its signature; return True for a new signature."""
        key = hashlib.blake2b(finding.signature.encode(), digest_size=6).hexdigest()
        path = self.folder / f"{key}.input"
        new = not path.exists()
        if new or len(data) < path.stat().st_size:
            path.write_bytes(data)
            path.with_suffix(".txt").write_text(
                f"{finding.signature}\n\n{finding.detail}\n", encoding="utf-8", errors="backslashreplace"
            )
        return new

    def all(self) -> list[tuple[str, Path]]:
        """Return all signatures with the paths of their inputs."""
        paths = sorted(self.folder.glob("*.input"))
        return [
            (path.with_suffix(".txt").read_text(encoding="utf-8").partition("\n")[0], path) for path in paths
        ]
