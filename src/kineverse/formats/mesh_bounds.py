"""Meshes of a document, which says where they are but not where they may be."""

from __future__ import annotations

from dataclasses import replace

from kineverse.model.body import Body, Mesh, Shape

from .packages import outside
from .remarks import tell


def bounded(body: Body, root: str, where: str) -> Body:
    """Return a body whose meshes do not leave a root; those that would are remarked on.

    Parameters
    ----------
    body
        As the document says it.
    root
        The folder, as :func:`.roots.root_of` returns it.
    where
        The document and the body, for remarks.
    """

    def shape(given: Shape) -> Shape:
        mesh = given.geometry
        if not isinstance(mesh, Mesh):
            return given
        wrong = outside(mesh.uri, mesh.folder, root)
        if wrong is not None:
            tell([f"{where}: names the mesh {wrong}"])
        return replace(given, geometry=replace(mesh, root=root))

    if not any(isinstance(given.geometry, Mesh) for given in (*body.visuals, *body.collisions)):
        return body
    return replace(
        body, visuals=tuple(map(shape, body.visuals)), collisions=tuple(map(shape, body.collisions))
    )
