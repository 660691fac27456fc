"""Calls of OpenUSD: imports when used, layers of one file, diagnostics, and poses as Gf values."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError, list_some
from kineverse.formats.description import Matrix
from kineverse.formats.files import read_file
from kineverse.formats.isolation import IsolatedCallError, call_isolated
from kineverse.formats.poses import unit_quaternion
from kineverse.lie import quaternion, transform

NAME = "kineverse:name"
"""Attribute with the name of a frame or of a coordinate in the model; that of a prim is an identifier."""

FREE = "kineverse:free"
"""Attribute of a body that moves freely: the name of its motion, ``name/x`` … ``name/qw``."""

HOME = "kineverse:home"
"""Attribute of a body that moves freely: the seven coordinates of its motion where it is on the stage."""

LOOP, DEPENDENT = "kineverse:loop", "kineverse:dependent"
"""Attributes of a joint that closes a loop: the name of the loop, and the coordinates that depend on it."""

MASSLESS = "kineverse:massless"
"""Attribute of a body that has a mass only because engines move none without."""

COORDINATE = "kineverse:coordinate:{}"
"""Attribute of a joint with several degrees of freedom: the coordinate of one, such as ``transX``."""

LEADER, COEFFICIENTS = "kineverse:mimicJoint", "kineverse:mimicCoefficients"
"""Joint that one of another type follows, and offset and factor in [m] and [rad]: Newton has no unit."""

TRANSLATIONS, ROTATIONS = ("transX", "transY", "transZ"), ("rotX", "rotY", "rotZ")
"""Names of the degrees of freedom of a generic joint in UsdPhysics."""

LARGEST_FLOAT = float(np.finfo(np.float32).max)  # bounds beyond it are none: USD has them in single precision

_BINARY = b"PXR-USDC"  # start of a binary file
_LONGEST_REASON = 300  # characters of an error of OpenUSD that are shown: it quotes the file
_REASON = re.compile(r"Error in '[^']*' at line \d+ in file \S+ : '(.*?)'\s*(?=Error in '|$)", re.DOTALL)


@cache
def pxr() -> Any:
    """Import the modules of OpenUSD when they are first needed."""
    try:
        import_module("newton_usd_schemas")  # registers its schemas; has to come before the first look at any
        names = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdPhysics", "UsdUtils", "Vt")
        return SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in names})
    except ImportError as error:
        raise MissingDependencyError(
            f"USD files need OpenUSD and the schemas of Newton: {install_command('usd')}"
        ) from error


@contextmanager
def capture_diagnostics() -> Iterator[list[str]]:
    """Capture the warnings of OpenUSD in a list; otherwise they go to the terminal."""
    captured: list[str] = []
    delegate = pxr().UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield captured
    finally:
        captured += [str(item.commentary) for item in delegate.TakeUncoalescedDiagnostics()]
        del delegate


def open_stage(path: Path) -> Any:
    """Open the stage of one file, as it is on disk now; refuse a file that is composed of further ones."""
    api = pxr()
    with capture_diagnostics():
        try:
            layer = _open_layer(path)
            others = [name for name in layer.GetCompositionAssetDependencies() if name]
            stage = None if others else api.Usd.Stage.Open(layer)
        except api.Tf.ErrorException as error:
            raise _unreadable(path, _reason(error, path)) from None
    if others:
        raise FormatError(
            f"{path} is composed of further files, {list_some(others, 3)}, which are not opened. Write all "
            f"into one file first: usdcat --flatten {path.name} -o flat.usda"
        )
    return stage


def _open_layer(path: Path) -> Any:
    """Open the layer of a file; a binary one as the text that a process of its own makes of it.

    One wrong byte in a binary file may have OpenUSD loop for ever, or crash.
    """
    layers = pxr().Sdf.Layer
    if not read_file(path).startswith(_BINARY):
        # A layer that is opened by its path may be an older one, which somebody in the process still holds.
        layer = layers.OpenAsAnonymous(str(path))
        if layer is None:
            raise _unreadable(path, "its content is that of no USD file")
        return layer
    try:
        text, reason = call_isolated(__name__, "export_layer", str(path.absolute()))
    except IsolatedCallError as error:
        raise _unreadable(path, str(error)) from None
    if reason:
        raise _unreadable(path, reason)
    layer = layers.CreateAnonymous(".usda")
    layer.ImportFromString(text)
    return layer


def export_layer(path: str) -> tuple[str, str]:
    """Return the text of a binary layer, or the reason why it cannot be read."""
    api = pxr()
    try:
        layer = api.Sdf.Layer.OpenAsAnonymous(path)
        return ("", "its content is damaged") if layer is None else (layer.ExportToString(), "")
    except api.Tf.ErrorException as error:
        return "", _reason(error, Path(path))


def _unreadable(path: Path, reason: str) -> FormatError:
    return FormatError(f"{path} is no USD that can be read: {reason}.")


@contextmanager
def refuse_errors(source: str) -> Iterator[None]:
    """Turn the errors of OpenUSD, as about values of a wrong type, into one of the file."""
    try:
        yield
    except pxr().Tf.ErrorException as error:
        raise FormatError(f"{source} is no USD that can be read: {_reason(error, Path(source))}.") from None


def _reason(error: Exception, path: Path) -> str:
    """Return the reason in an error of OpenUSD on one line, without the file and places in its sources."""
    text, file = str(error).strip(), os.path.abspath(path)
    found = _REASON.search(text)
    reason = (found[1] if found else text).replace(f"<{file}>", "it").replace(f"{file}:", "line ")
    return " ".join(reason.split()).removesuffix(".")[:_LONGEST_REASON]


def to_gf_matrix(pose: Matrix) -> Any:
    """Return a transform as a ``Gf.Matrix4d``, which multiplies row vectors."""
    return pxr().Gf.Matrix4d(*pose.T.ravel().tolist())


def to_gf_quaternion(pose: Matrix) -> Any:
    """Return the rotation of a transform as a ``Gf.Quatf``."""
    x, y, z, w = unit_quaternion(pose)
    return pxr().Gf.Quatf(w, x, y, z)


def pose_from_gf(position: Any, orientation: Any) -> Matrix:
    """Return a position and a quaternion of Gf, in single precision, as a transform."""
    x, y, z = orientation.GetImaginary()
    xyzw = np.array([x, y, z, orientation.GetReal()], dtype=float)
    length = float(np.linalg.norm(xyzw))
    turn = np.eye(3) if not length > 0 else quaternion(xyzw / length)
    result: Matrix = transform(turn, np.array(tuple(position), dtype=float))
    return result


def set_text(prim: Any, attribute: str, text: str) -> None:
    """Set a custom attribute of a prim to a text."""
    prim.CreateAttribute(attribute, pxr().Sdf.ValueTypeNames.String, True).Set(text)


def text_of(prim: Any, attribute: str) -> str | None:
    """Return the text of a custom attribute; None if the prim has none."""
    value = prim.GetAttribute(attribute).Get() if prim.HasAttribute(attribute) else None
    return value if isinstance(value, str) and value else None


def numbers_of(prim: Any, attribute: str, count: int) -> tuple[float, ...]:
    """Return the first numbers of an attribute that is authored; none if there are fewer finite ones."""
    found = prim.GetAttribute(attribute)
    value = found.Get() if found and found.HasAuthoredValue() else None
    try:
        numbers = tuple(np.ravel(np.array(value, dtype=float))[:count].tolist()) if value is not None else ()
    except (TypeError, ValueError):
        return ()
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else ()


def number_of(prim: Any, attribute: str) -> float | None:
    """Return the number of an attribute, by default that of its schema; None if it has none."""
    value = prim.GetAttribute(attribute).Get() if prim.HasAttribute(attribute) else None
    return float(value) if isinstance(value, (int, float)) and not np.isnan(value) else None
