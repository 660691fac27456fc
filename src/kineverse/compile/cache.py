"""Compiled libraries on disk, by the digest of what they are made from.

Code from this folder is loaded into the process, so nobody else may be able to write there: it is made with
mode 0700, and refused if it belongs to someone else or others may write to it. Every library ends in a digest
of itself that is checked before it is loaded; a broken one counts as absent. Libraries arrive by renaming, so
any number of processes can share the folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import shutil
import tempfile
import time
from pathlib import Path

logger = logging.getLogger("kineverse.compile")

MAXIMUM_BYTES = 512 * 2**20

# The end of every library: this, then the SHA-256 of everything before it. Loaders ignore what follows the
# image.
_MARK = b"\nkineverse library sha256 "
_TRAILER = len(_MARK) + 32
_STALE_SECONDS = 3600.0
_LAST_USE_RESOLUTION = 3600.0


class LibraryCache:
    """One folder of compiled libraries.

    Parameters
    ----------
    folder
        An existing folder that only this user can write to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._text = str(folder)

    def find(self, key: str) -> str | None:
        """Return the path of a library that is there and whole, else None."""
        path = f"{self._text}/{key}.so"
        try:
            with open(path, "rb") as file:
                content = file.read()
                last_use = os.fstat(file.fileno()).st_mtime
        except OSError:
            return None
        digest = hashlib.sha256(memoryview(content)[:-_TRAILER]).digest()
        if len(content) <= _TRAILER or content[-_TRAILER:] != _MARK + digest:
            logger.warning("The compiled library %s is damaged and will be made anew.", path)
            self.discard(key)
            return None
        if time.time() - last_use > _LAST_USE_RESOLUTION:
            with contextlib.suppress(OSError):
                os.utime(path)
        return path

    def store(self, key: str, library: str) -> str:
        """Move a library that was just compiled in here; return its path.

        Parameters
        ----------
        key
            What it will be found by.
        library
            A file on the same file system (see :meth:`workplace`).
        """
        with open(library, "r+b") as file:
            digest = hashlib.sha256(file.read()).digest()
            file.write(_MARK + digest)
        path = f"{self._text}/{key}.so"
        os.replace(library, path)
        self._make_room()
        return path

    def discard(self, key: str) -> None:
        """Remove a library."""
        with contextlib.suppress(OSError):
            os.unlink(f"{self._text}/{key}.so")

    def workplace(self) -> str:
        """Return a new folder to compile in; the caller removes it."""
        return tempfile.mkdtemp(prefix=".build-", dir=self._text)

    def _make_room(self) -> None:
        """Remove what was used longest ago, and what processes left behind that were killed."""
        files: list[tuple[float, int, str]] = []
        now = time.time()
        for entry in os.scandir(self._text):
            with contextlib.suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                if entry.name.startswith(".build-"):
                    if now - status.st_mtime > _STALE_SECONDS:
                        shutil.rmtree(entry.path, ignore_errors=True)
                elif entry.name.endswith(".so"):
                    files.append((status.st_mtime, status.st_size, entry.path))
        excess = sum(size for _, size, _ in files) - MAXIMUM_BYTES
        for _, size, path in sorted(files):
            if excess <= 0:
                break
            with contextlib.suppress(OSError):
                os.unlink(path)
            excess -= size


def library_cache() -> LibraryCache:
    """Return the cache of this user.

    The folder is ``KINEVERSE_CACHE_DIR``, else ``kineverse`` in ``XDG_CACHE_HOME``, else
    ``~/.cache/kineverse``. Where that cannot be used, a private folder that is removed when the process ends
    takes its place, and the log says why.
    """
    get = os.environ.get
    return _open(get("KINEVERSE_CACHE_DIR"), get("XDG_CACHE_HOME"), get("HOME"))


@functools.lru_cache(maxsize=16)
def _open(folder: str | None, caches: str | None, home: str | None) -> LibraryCache:
    if folder:
        wanted = Path(folder).absolute()
    elif caches and os.path.isabs(caches):
        wanted = Path(caches) / "kineverse"
    else:
        wanted = Path(home or os.path.expanduser("~")) / ".cache" / "kineverse"
    reason = _why_not(wanted)
    if reason is None:
        return LibraryCache(wanted)
    logger.warning(
        "Compiled functions are not kept for other processes: the cache folder %s %s.", wanted, reason
    )
    return LibraryCache(Path(_private_folder().name))


def _why_not(folder: Path) -> str | None:
    """Return why libraries cannot or must not be kept in the folder; None if all is well."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.stat()
    except OSError as error:
        return f"cannot be made ({error.strerror})"
    if hasattr(os, "geteuid") and status.st_uid != os.geteuid():
        return "belongs to another user"
    if status.st_mode & 0o022:
        return f"can be written by others (its mode is {status.st_mode & 0o777:o}; make it 700)"
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        return "cannot be written"
    return None


@functools.lru_cache(maxsize=1)
def _private_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="kineverse-", ignore_cleanup_errors=True)


def _forked() -> None:
    if _private_folder.cache_info().currsize:
        # The parent's folder is the parent's to remove.
        _private_folder()._finalizer.detach()  # type: ignore[attr-defined]
        _private_folder.cache_clear()
        _open.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
