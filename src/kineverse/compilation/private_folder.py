"""Folder that only this user can write to, held open against replacement.

Code from the cache is loaded into the process. So each folder and link on the path is checked: it belongs to
root or to this user, and others cannot write to it, unless it is sticky like ``/tmp``. Files are opened
relative to the checked folder, without following links. An opened file is checked as well: it is a plain file
of this user, with one name, and others cannot write to it. On systems without such calls, names are joined to
the path.
"""

from __future__ import annotations

import contextlib
import os
import stat
import weakref
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_MOST_LINKS = 40
_BY_DESCRIPTOR = hasattr(os, "geteuid") and {os.open, os.stat, os.unlink, os.rename} <= os.supports_dir_fd
_FOLDER = getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
_STEP = _FOLDER | getattr(os, "O_PATH", os.O_RDONLY)
# Opening a pipe must not block.
_FILE = (
    os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
)


class NotPrivateError(Exception):
    """Raised for files and folders that others may have written; the message begins with a verb."""


class PrivateFolder:
    """A folder that only this user can write to."""

    def __init__(self, path: Path, made: bool = False) -> None:
        self.path = path
        if not made:
            _make(path)
        self._descriptor: int | None = None
        if _BY_DESCRIPTOR:
            self._descriptor = os.open(path, _FOLDER | os.O_RDONLY) if made else _walk(path)
            weakref.finalize(self, os.close, self._descriptor).atexit = False
        if not os.access(path, os.R_OK | os.W_OK | os.X_OK):
            raise NotPrivateError("cannot be written")

    @property
    def is_still_private(self) -> bool:
        """True if the folder still exists and only this user can write to it."""
        if self._descriptor is None:
            return self.path.is_dir()
        status = os.fstat(self._descriptor)
        return status.st_nlink > 0 and _refusal(status) is None

    def open(self, name: str) -> int:
        """Return the descriptor of a file in the folder, to be closed by the caller."""
        try:
            descriptor = os.open(*self._at(name, _FILE), **self._relative())
        except OSError:
            if self.is_link(name):
                raise NotPrivateError("is a link") from None
            raise
        reason = _file_refusal(os.fstat(descriptor))
        if reason is not None:
            os.close(descriptor)
            raise NotPrivateError(reason)
        return descriptor

    def is_link(self, name: str) -> bool:
        """Return True if a symbolic link has that name."""
        try:
            return stat.S_ISLNK(os.stat(*self._at(name), follow_symlinks=False, **self._relative()).st_mode)
        except OSError:
            return False

    def adopt(self, path: str, name: str, end: bytes = b"") -> None:
        """Move a file into the folder, in place of one of that name, with access for this user only."""
        with open(os.open(path, os.O_APPEND | os.O_RDWR | _FILE), "ab") as file:
            reason = _file_refusal(os.fstat(file.fileno()), writable=False)
            if reason is not None:
                raise NotPrivateError(reason)
            if hasattr(os, "fchmod"):
                os.fchmod(file.fileno(), 0o600)
            file.write(end)
        if self._descriptor is None:
            os.replace(path, self.path / name)
        else:
            os.replace(path, name, dst_dir_fd=self._descriptor)

    def remove(self, name: str) -> bool:
        """Remove a file or link, and return True if that succeeded."""
        with contextlib.suppress(OSError):
            os.unlink(*self._at(name), **self._relative())
            return True
        return False

    def entries(self) -> Iterator[tuple[str, os.stat_result]]:
        """Yield the names and the status of all entries; links are not followed."""
        with os.scandir(self.path if self._descriptor is None else self._descriptor) as found:
            for entry in found:
                with contextlib.suppress(OSError):
                    yield entry.name, entry.stat(follow_symlinks=False)

    def _at(self, name: str, *others: int) -> tuple[Any, ...]:
        return (name if self._descriptor is not None else os.path.join(self.path, name), *others)

    def _relative(self) -> dict[str, Any]:
        return {} if self._descriptor is None else {"dir_fd": self._descriptor}


def _make(path: Path) -> None:
    """Create a folder and its missing parents, with access for this user only."""
    missing = []
    while not os.path.lexists(path):
        missing.append(path)
        path = path.parent
    for folder in reversed(missing):
        with contextlib.suppress(FileExistsError):
            os.mkdir(folder, 0o700)


def _walk(path: Path) -> int:
    """Return the descriptor of a folder after checking every folder and link on its path."""
    parts = deque(path.parts[1:])
    here = os.open(path.anchor, _STEP)
    passed, links = path.anchor, 0
    try:
        while parts:
            _check_passage(os.fstat(here), passed)
            name = parts.popleft()
            passed = os.path.join(passed, name)
            status = os.stat(name, dir_fd=here, follow_symlinks=False)
            if stat.S_ISLNK(status.st_mode):
                links += 1
                if status.st_uid not in (0, os.geteuid()) or links > _MOST_LINKS:
                    raise NotPrivateError(f"is reached through {passed}, a link of another user")
                target = Path(os.readlink(name, dir_fd=here))
                if target.is_absolute():
                    os.close(here)
                    here, passed = os.open(target.anchor, _STEP), target.anchor
                else:
                    passed = os.path.dirname(passed)
                parts.extendleft(reversed(target.parts[1:] if target.is_absolute() else target.parts))
                continue
            following = os.open(name, _STEP, dir_fd=here)
            os.close(here)
            here = following
        reason = _refusal(os.fstat(here))
        if reason is not None:
            raise NotPrivateError(reason)
        return os.open(".", _FOLDER | os.O_RDONLY, dir_fd=here)
    finally:
        os.close(here)


def _check_passage(status: os.stat_result, passed: str) -> None:
    """Raise for a folder in which others can replace entries."""
    if status.st_uid not in (0, os.geteuid()):
        raise NotPrivateError(f"is reached through {passed}, which belongs to another user")
    if status.st_mode & _OTHERS and not status.st_mode & stat.S_ISVTX and not _own_group(status):
        raise NotPrivateError(
            f"is reached through {passed}, which can be written by others (its mode is "
            f"{status.st_mode & 0o7777:o})"
        )


def _own_group(status: os.stat_result) -> bool:
    """Return True if only the group can write, and it is the private group of this user."""
    if status.st_mode & stat.S_IWOTH or os.geteuid() == 0 or status.st_gid != os.getegid():
        return False
    import grp
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(status.st_gid)
    except KeyError:
        return False
    return (
        user.pw_gid == group.gr_gid
        and user.pw_name == group.gr_name
        and not set(group.gr_mem) - {user.pw_name}
    )


def _refusal(status: os.stat_result) -> str | None:
    """Return the reason why others can write to a folder; None if they cannot."""
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    if status.st_mode & _OTHERS:
        return f"can be written by others (its mode is {status.st_mode & 0o777:o})"
    return None


def _file_refusal(status: os.stat_result, writable: bool = True) -> str | None:
    """Return the reason why an opened file is not a plain file of this user alone; None if it is."""
    if not stat.S_ISREG(status.st_mode):
        return "is no plain file"
    if not _BY_DESCRIPTOR:
        return None
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    if writable and status.st_mode & _OTHERS:
        return "can be written by others"
    # A file without a name was replaced after it was opened, which does no harm.
    if status.st_nlink > 1:
        return "has other names"
    return None
