"""Folder that only this user can write to, held open against replacement.

Code from the cache is loaded into the process. So the way to the folder is walked one step after the other:
every folder on it belongs to root or to this user and cannot be written by others, unless it is sticky like
``/tmp``, and so does every link. Files are opened relative to the folder that was checked, links are not
followed, and what was opened is looked at: a plain file of this user, with one name, which nobody else can
write to. Where the system has no such calls, names are joined to the path.
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
# A pipe must not keep anybody waiting.
_FILE = (
    os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
)


class NotPrivateError(Exception):
    """Raised for what others may have written; the message begins with a verb."""


class PrivateFolder:
    """A folder that only this user can write to.

    Parameters
    ----------
    path
        Where it is; it is made with mode 0700 if it is not there.
    made
        Whether it was just made by this process, so that there is nothing to check.

    Raises
    ------
    NotPrivateError
        If others can write to it or put another one in its place.
    OSError
        If it cannot be made or opened.
    """

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
        """Whether it is still there, and still nobody else's."""
        if self._descriptor is None:
            return self.path.is_dir()
        status = os.fstat(self._descriptor)
        return status.st_nlink > 0 and _refusal(status) is None

    def open(self, name: str) -> int:
        """Return the descriptor of a file in the folder, to be closed by the caller.

        Raises
        ------
        NotPrivateError
            If it is no plain file of this user alone.
        OSError
            If there is none.
        """
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
        """Whether there is a symbolic link of that name."""
        try:
            return stat.S_ISLNK(os.stat(*self._at(name), follow_symlinks=False, **self._relative()).st_mode)
        except OSError:
            return False

    def adopt(self, path: str, name: str, end: bytes = b"") -> None:
        """Move a file in here, over any that was there, and make it this user's alone.

        Parameters
        ----------
        path
            A file on the same file system.
        name
            How it is called here.
        end
            What is written behind its content.
        """
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
        """Remove a file or link, and return whether it is gone."""
        with contextlib.suppress(OSError):
            os.unlink(*self._at(name), **self._relative())
            return True
        return False

    def entries(self) -> Iterator[tuple[str, os.stat_result]]:
        """Yield the names of what is in here, with the status of each; links are not followed."""
        with os.scandir(self.path if self._descriptor is None else self._descriptor) as found:
            for entry in found:
                with contextlib.suppress(OSError):
                    yield entry.name, entry.stat(follow_symlinks=False)

    def _at(self, name: str, *others: int) -> tuple[Any, ...]:
        return (name if self._descriptor is not None else os.path.join(self.path, name), *others)

    def _relative(self) -> dict[str, Any]:
        return {} if self._descriptor is None else {"dir_fd": self._descriptor}


def _make(path: Path) -> None:
    """Make a folder and those it is in, all of them for this user alone."""
    missing = []
    while not os.path.lexists(path):
        missing.append(path)
        path = path.parent
    for folder in reversed(missing):
        with contextlib.suppress(FileExistsError):
            os.mkdir(folder, 0o700)


def _walk(path: Path) -> int:
    """Return the descriptor of a folder after looking at everything on the way to it."""
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
    """Refuse a folder in which others can put something else in place of what leads on."""
    if status.st_uid not in (0, os.geteuid()):
        raise NotPrivateError(f"is reached through {passed}, which belongs to another user")
    if status.st_mode & _OTHERS and not status.st_mode & stat.S_ISVTX and not _own_group(status):
        raise NotPrivateError(
            f"is reached through {passed}, which can be written by others (its mode is "
            f"{status.st_mode & 0o7777:o})"
        )


def _own_group(status: os.stat_result) -> bool:
    """Whether only the group can write, and it is one that a system made for this user, of that name."""
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
    """Return why a folder is not this user's alone; None if it is."""
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    if status.st_mode & _OTHERS:
        return f"can be written by others (its mode is {status.st_mode & 0o777:o})"
    return None


def _file_refusal(status: os.stat_result, writable: bool = True) -> str | None:
    """Return why what was opened is no plain file of this user alone; None if it is."""
    if not stat.S_ISREG(status.st_mode):
        return "is no plain file"
    if not _BY_DESCRIPTOR:
        return None
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    if writable and status.st_mode & _OTHERS:
        return "can be written by others"
    # Without a name it was replaced since it was opened, which is no harm.
    if status.st_nlink > 1:
        return "has other names"
    return None
