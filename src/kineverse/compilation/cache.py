"""Disk caches: files in a folder of this user alone, and compiled libraries by the digest of their source.

Every file ends in a digest of its content. A file that is damaged, or that others can write to, counts as
absent. Files are renamed into place, so any number of processes can share the folder, and an interruption
loses only the unfinished file.

Code from this folder is loaded into the process, so only this user may write to it, see
:mod:`.private_folder`. A library is loaded through the checked descriptor; one that lacks the expected
functions is compiled again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from kineverse.errors import FormatError

from .private_folder import NotPrivateError, PrivateFolder

UNFINISHED = ".making-"  # beginning of the names of files and folders that are not finished

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
        # One that is larger than the limit is not kept, instead of all others.
        files = sorted(self._files(), key=lambda file: (file[1] <= self.most_bytes, file))
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
        result, folder = [], self.folder
        for name, status in folder.entries():
            if name.endswith(self._ending):
                result.append((status.st_mtime, status.st_size, name.removesuffix(self._ending)))
            elif name.startswith(UNFINISHED) and time.time() - status.st_mtime > _STALE_SECONDS:
                if not folder.remove(name):
                    shutil.rmtree(folder.path / name, ignore_errors=True)
        return result


logger = logging.getLogger("kineverse.compile")

# Folders in which compilation has failed for lack of room, with the reason.
_without_room: dict[Path, str] = {}

MAXIMUM_BYTES = 512 * 2**20

# The end of every library: this, then the SHA-256 of everything before it. Loaders ignore what follows the
# image.
_MARK = b"\nkineverse library sha256 "

_DESCRIPTORS = "/proc/self/fd/"
_loaded = itertools.count(1)

Code = TypeVar("Code")


class LibraryCache:
    """A folder of compiled libraries."""

    def __init__(self, folder: Path, made: bool = False) -> None:
        self.folder = folder
        self._inside = inside = PrivateFolder(folder, made)
        complaint = "The compiled library %s %s and will be compiled again."
        self._files = ContentCache(lambda: inside, ".so", MAXIMUM_BYTES, logger, complaint, _MARK)

    @property
    def is_still_private(self) -> bool:
        """True if the folder still exists and only this user can write to it."""
        return self._inside.is_still_private

    def find(self, key: str) -> str | None:
        """Return the path of a library that exists and is undamaged, else None."""
        found = self._files.open(key)
        if found is None:
            return None
        os.close(found[0])
        return self._files.path(key)

    def load(self, key: str, load: Callable[[str], Code]) -> Code | None:
        """Return the code of a library; None if it does not exist or cannot be used."""
        found = self._files.open(key)
        if found is None:
            return None
        try:
            with _path_of(*found) as path:
                return load(path)
        except (OSError, RuntimeError, AttributeError, ImportError) as error:
            self._files.discard(key, f"cannot be used ({error})")
            return None
        finally:
            os.close(found[0])

    def store(self, key: str, library: str) -> str:
        """Move a compiled library into the folder, and return its path."""
        self._files.adopt(library, key)
        return self._files.path(key)

    def create_build_folder(self) -> str:
        """Create a folder to compile in, which the caller removes, and return its path."""
        return tempfile.mkdtemp(prefix=UNFINISHED, dir=self.folder)


def cache_folder() -> Path:
    """Return the path of the cache of this user.

    It is ``KINEVERSE_CACHE_DIR``, else ``kineverse`` in ``XDG_CACHE_HOME``, else ``.cache/kineverse`` in
    ``HOME``, else in the home folder of the account; the last three are absolute paths, or ignored.
    """
    get = os.environ.get
    return _choose_folder(get("KINEVERSE_CACHE_DIR"), get("XDG_CACHE_HOME"), get("HOME"))


def library_cache() -> LibraryCache:
    """Return the cache of this user in :func:`cache_folder`.

    If that folder cannot be used, which is logged, it is a private one that is removed when the process ends.
    """
    where = cache_folder()
    cache = _open(where)
    if not cache.is_still_private:  # removed, or opened to others since
        _open.cache_clear()
        cache = _open(where)
    return cache


def avoid_full_cache(cache: LibraryCache, reason: str) -> LibraryCache:
    """Return a cache in place of one without room, for this process; log the reason, once."""
    if cache.folder not in _without_room:
        if _private_folder.cache_info().currsize and cache.folder == Path(_private_folder().name):
            raise OSError(reason)
        _private_folder()  # raises if there is no folder for temporary files
        _without_room[cache.folder] = reason
        logger.warning(
            "Compiled functions are not kept for other processes: the cache folder %s has no room (%s).",
            cache.folder,
            reason,
        )
        _open.cache_clear()
    return library_cache()


def private_subfolder(name: str) -> PrivateFolder:
    """Return a folder in the cache of this user, or in a private one that is removed with the process."""
    path = library_cache().folder / name
    try:
        return PrivateFolder(path)
    except (NotPrivateError, OSError) as error:
        logger.warning(
            "What is computed is not kept for other processes: the cache folder %s",
            describe_failure(path, error),
        )
    path = Path(_private_folder().name) / name
    path.mkdir(mode=0o700, exist_ok=True)
    return PrivateFolder(path, made=True)


def describe_failure(folder: Path, error: Exception) -> str:
    """Return the path of a cache folder that cannot be used, the reason, and what to do."""
    if isinstance(error, OSError):
        return f"{folder} cannot be made or opened ({error.strerror})."
    return (
        f"{folder} {error}. Others may have left code in it: remove it with all it holds, or set "
        "KINEVERSE_CACHE_DIR to a folder of your own."
    )


@functools.lru_cache(maxsize=16)
def _choose_folder(folder: str | None, caches: str | None, home: str | None) -> Path:
    if folder:
        return Path(folder).absolute()  # of the first working folder of the process
    if caches and os.path.isabs(caches):
        return Path(caches) / "kineverse"
    return _home(home) / ".cache" / "kineverse"


@functools.lru_cache(maxsize=16)
def _open(wanted: Path) -> LibraryCache:
    if wanted not in _without_room:
        try:
            return LibraryCache(wanted)
        except (NotPrivateError, OSError) as error:
            logger.warning(
                "Compiled functions are not kept for other processes: the cache folder %s",
                describe_failure(wanted, error),
            )
    if not _private_folder_is_there():
        _private_folder.cache_clear()
    try:
        return LibraryCache(Path(_private_folder().name), made=True)
    except OSError as error:
        return _NoCache(error)


class _NoCache(LibraryCache):
    """A cache without a folder: empty, and nothing can be compiled in it."""

    def __init__(self, error: OSError) -> None:
        self.folder, self._error = Path(os.devnull), error

    @property
    def is_still_private(self) -> bool:
        return False  # there may be a folder next time

    def find(self, key: str) -> None:
        return None

    def load(self, key: str, load: Callable[[str], Code]) -> None:
        return None

    def store(self, key: str, library: str) -> str:
        raise self._error

    def create_build_folder(self) -> str:
        raise self._error


def _home(home: str | None) -> Path:
    """Return the home folder: the given one if it is absolute, else that of the account."""
    if home and os.path.isabs(home):
        return Path(home)
    try:
        import pwd

        return Path(pwd.getpwuid(os.getuid()).pw_dir)
    except (ImportError, KeyError):  # Windows, or a user without an account
        return Path.home() if os.name == "nt" else Path(os.sep)


@contextlib.contextmanager
def _path_of(descriptor: int, content: bytes) -> Iterator[str]:
    """Yield a unique path of an open file, for the loader.

    On Linux it is the path of the descriptor, with the number of the library encoded in slashes and dots.
    Elsewhere the content is written to a private folder.
    """
    number = next(_loaded)
    path = f"{_DESCRIPTORS}{''.join('./' if bit == '1' else '/' for bit in f'{number:b}')}{descriptor}"
    if os.path.exists(path):
        yield path
        return
    path = os.path.join(_private_folder().name, f"{number}.so")
    Path(path).write_bytes(content)
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):
            os.unlink(path)


@functools.lru_cache(maxsize=1)
def _private_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="kineverse-", ignore_cleanup_errors=True)


def _private_folder_is_there() -> bool:
    return not _private_folder.cache_info().currsize or os.path.isdir(_private_folder().name)


def _forked() -> None:
    if _private_folder.cache_info().currsize:
        # The parent process removes its own folder.
        _private_folder()._finalizer.detach()  # type: ignore[attr-defined]
        _private_folder.cache_clear()
        _open.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
