"""PNG files from arrays, by the standard library alone."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError, ShapeError


def write_png(path: str | Path, pixels: npt.NDArray[np.uint8]) -> None:
    """Write an image of (height, width, 3) or (height, width, 4) bytes to a PNG file.

    Raises
    ------
    ShapeError
        If the array is not an image of 8 bits a channel.
    FormatError
        If the name says that it is a file of another kind, see :func:`check_png_name`.
    """
    check_png_name(path)
    Path(path).write_bytes(encode_png(pixels))


def check_png_name(path: str | Path) -> None:
    """Look whether a file may be called so: it ends in .png, or says nothing about its kind.

    Raises
    ------
    FormatError
        If it ends in something else.
    """
    suffix = Path(path).suffix
    if suffix.lower() not in ("", ".png"):
        raise FormatError(f"Pictures are written as .png, not {suffix}: '{Path(path).with_suffix('.png')}'.")


def encode_png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Return the bytes of a PNG file (ISO/IEC 15948: colour type 2 or 6, no interlace)."""
    image = np.asarray(pixels)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8 or not image.size:
        raise ShapeError(f"an image is (height, width, 3 or 4) of uint8, not {image.shape} of {image.dtype}")
    height, width, channels = image.shape
    header = struct.pack(">IIBBBBB", width, height, 8, 2 if channels == 3 else 6, 0, 0, 0)
    # Each row as its difference to the row above (filter 2): pictures of rooms shrink to a third by it.
    rows = image.reshape(height, width * channels)
    lines = np.empty((height, 1 + width * channels), dtype=np.uint8)
    lines[:, 0] = 2
    lines[0, 1:] = rows[0]
    lines[1:, 1:] = rows[1:] - rows[:-1]
    body = zlib.compress(lines.tobytes(), 6)
    chunks = _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
