"""What was found, in a folder: for each signature the smallest input, and what happened."""

from __future__ import annotations

import hashlib
from pathlib import Path

from .law import Finding


class Records:
    """The findings of a target."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def add(self, finding: Finding, data: bytes) -> bool:
        """Keep an input if there is no smaller one for the same reason; return whether the reason is new."""
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
        """Return signatures and inputs."""
        paths = sorted(self.folder.glob("*.input"))
        return [
            (path.with_suffix(".txt").read_text(encoding="utf-8").partition("\n")[0], path) for path in paths
        ]
