"""Disk cache of contents: files in a folder of this user alone, each of which ends in a digest.

A file that is damaged, or that others can write to, counts as absent. Files are renamed into place, so any
number of processes can share the folder, and an interruption loses only the unfinished file.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from kineverse.errors import FormatError

from .private_folder import NotPrivateError, PrivateFolder

UNFINISHED = ".making-"
"""Beginning of the names of files and folders that are not finished."""

_STALE_SECONDS = 3600.0
_LAST_USE_RESOLUTION = 3600.0
_DIGEST = 32

Content = TypeVar("Content")


class ContentCache:
    """Files by key in a folder that only this user can write to."""

    def __init__(
        self,
        open_folder: Callable[[], PrivateFolder],
        ending: str,
        most_bytes: int,
        logger: logging.Logger,
        complaint: str,
        mark: bytes = b"",
    ) -> None:
        self.most_bytes = most_bytes
        self._open_folder, self._ending, self._mark = open_folder, ending, mark
        self._logger, self._complaint = logger, complaint

    @property
    def folder(self) -> PrivateFolder:
        """The folder."""
        return self._open_folder()

    def open(self, key: str, used: bool = True) -> tuple[int, bytes] | None:
        """Return the descriptor of a file, to be closed by the caller, and its content without the end.

        None if there is no such file, or it cannot be used. If ``used``, it counts as used now.
        """
        try:
            descriptor = self.folder.open(key + self._ending)
        except NotPrivateError as error:
            self.discard(key, str(error))
            return None
        except OSError:
            return None
        with open(descriptor, "rb", closefd=False) as file:
            whole = memoryview(file.read())
        size = len(whole) - len(self._mark) - _DIGEST
        if size < 0 or whole[size:] != self._end(whole[:size]):
            os.close(descriptor)
            self.discard(key, "is damaged")
            return None
        if used and time.time() - os.fstat(descriptor).st_mtime > _LAST_USE_RESOLUTION:
            with contextlib.suppress(OSError):
                os.utime(descriptor)
        return descriptor, bytes(whole[:size])

    def read(self, key: str, parse: Callable[[bytes], Content], used: bool = True) -> Content | None:
        """Return what a function makes of the content of a file, see :meth:`open`.

        A file for which the function raises FormatError counts as absent.
        """
        found = self.open(key, used)
        if found is None:
            return None
        os.close(found[0])
        try:
            return parse(found[1])
        except FormatError:
            self.discard(key, "is damaged")
            return None

    def read_all(self, parse: Callable[[bytes], Content]) -> Iterator[tuple[Content, int]]:
        """Yield what a function makes of every file, see :meth:`read`, and the size of the file [bytes]."""
        for _, size, key in self._files():
            content = self.read(key, parse, used=False)
            if content is not None:
                yield content, size

    def list_keys(self) -> list[str]:
        """Return the keys of all files."""
        return [key for _, _, key in self._files()]

    def write(self, key: str, content: bytes) -> None:
        """Write a file atomically; where that fails, such as on a full disk, the log says so."""
        path = None
        try:
            handle, path = tempfile.mkstemp(prefix=UNFINISHED, dir=self.folder.path)
            with open(handle, "wb") as file:
                file.write(content)
            self.adopt(path, key)
        except OSError as error:
            self._logger.warning("%s cannot be written: %s.", self.path(key), error.strerror)
        finally:
            if path is not None:
                with contextlib.suppress(OSError):
                    os.unlink(path)

    def adopt(self, path: str, key: str) -> None:
        """Move a file of the same file system into the folder."""
        with open(path, "rb") as file:
            end = self._end(file.read())
        self.folder.adopt(path, key + self._ending, end)
        files = sorted(self._files())
        excess = sum(size for _, size, _ in files) - self.most_bytes
        for _, size, other in files:
            if excess <= 0:
                break
            self.folder.remove(other + self._ending)
            excess -= size

    def discard(self, key: str, reason: str) -> None:
        """Remove a file that cannot be used, and log why."""
        self._logger.warning(self._complaint, self.path(key), reason)
        self.folder.remove(key + self._ending)

    def clear(self) -> int:
        """Remove all files, and return their number."""
        folder = self.folder
        return sum(folder.remove(key + self._ending) for key in self.list_keys())

    def path(self, key: str) -> str:
        """Return the path of a file, which need not exist."""
        return str(self.folder.path / (key + self._ending))

    def _end(self, content: bytes | memoryview) -> bytes:
        return self._mark + hashlib.sha256(content).digest()

    def _files(self) -> list[tuple[float, int, str]]:
        """Return the time of the last use, the size and the key of each file; remove what was left behind."""
        found, folder = [], self.folder
        for name, status in folder.entries():
            if name.endswith(self._ending):
                found.append((status.st_mtime, status.st_size, name.removesuffix(self._ending)))
            elif name.startswith(UNFINISHED) and time.time() - status.st_mtime > _STALE_SECONDS:
                if not folder.remove(name):
                    shutil.rmtree(folder.path / name, ignore_errors=True)
        return found
