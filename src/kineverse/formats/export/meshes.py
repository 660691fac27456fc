"""What a file calls the meshes it refers to, when it lies elsewhere than the one that they are from."""

from __future__ import annotations

import os
from pathlib import Path

from kineverse.model.body import Mesh


def reference(mesh: Mesh, folder: Path) -> str:
    """Return the reference to a mesh from a file in ``folder``: addresses and absolute paths as they are."""
    if "://" in mesh.uri or os.path.isabs(mesh.uri) or not mesh.folder or Path(mesh.folder) == folder:
        return mesh.uri
    return Path(os.path.relpath(Path(mesh.folder, mesh.uri), folder)).as_posix()
