"""Addresses of model servers, and the folder in which those of this user are found.

A server ``NAME`` listens at the socket ``NAME.sock`` in a folder that only its user can enter; where there
are no Unix sockets, at a port of this computer, which stands with a secret in ``NAME.json``. While it runs it
holds a lock on ``NAME.held``, which ends with its process: nobody takes what a killed server has left for a
server.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import socket
import stat
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from kineverse.compilation.private_folder import NotPrivateError, PrivateFolder
from kineverse.errors import DuplicateNameError, FormatError, InvalidValueError, UnknownNameError, suggest

try:
    import fcntl
except ImportError:  # on Windows, where a server is known by its open port
    fcntl = None  # type: ignore[assignment]

SCHEME: Final = "live:"
UNIX_SOCKETS: Final = hasattr(socket, "AF_UNIX") and hasattr(os, "geteuid")

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,59}")
_ENDPOINT: Final = re.compile(r"unixsock-stream/[^?#]+|tcp/(?:[^/\s?#:]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}")
_LONGEST_SOCKET: Final = 103  # bytes of the path; systems allow 103 or 107
_FILES: Final = (".sock", ".sock.lock", ".json")  # the second is Zenoh's
_LOOK_SECONDS: Final = 0.1
_OPEN: Final = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)


@dataclass(frozen=True)
class Address:
    """Address of a model server: ``live:NAME``, or ``live:ENDPOINT/NAME``."""

    name: str
    endpoint: str = ""
    """``tcp/HOST:PORT`` or ``unixsock-stream/PATH``; empty for a server of this user."""

    @classmethod
    def parse(cls, text: str) -> Address:
        """Return the address that a text is; if it is none, that is a FormatError."""
        endpoint, _, name = text.removeprefix(SCHEME).rpartition("/")
        if not text.startswith(SCHEME) or (endpoint and not _ENDPOINT.fullmatch(endpoint)):
            raise FormatError(
                f"{text!r} is no address of a model server. It is {SCHEME}NAME, "
                f"{SCHEME}tcp/HOST:PORT/NAME or {SCHEME}unixsock-stream/PATH/NAME."
            )
        try:
            return cls(check_server_name(name), endpoint)
        except InvalidValueError as error:
            raise FormatError(f"{text!r} is no address of a model server. {error}") from None

    def __str__(self) -> str:
        return f"{SCHEME}{self.endpoint}/{self.name}" if self.endpoint else SCHEME + self.name

    def find(self) -> tuple[str, str]:
        """Return where the server listens, and the secret that it wants, empty for none.

        If no server of this user has the name, an UnknownNameError lists those that are there.
        """
        if self.endpoint:
            return self.endpoint, ""
        folder = runtime_folder()
        if not _is_served(folder, self.name):
            others = list_servers()
            hint = suggest(self.name, others) if others else "None is running; 'kineverse serve' starts one."
            raise UnknownNameError(f"There is no model server {self.name!r} of this user. {hint}")
        return _read_place(folder, self.name) or (_socket_endpoint(folder, self.name), "")


class Claim:
    """Name of a server that this process holds until :meth:`release`, or until it ends.

    With a source of state it is the name under which that listens beside the server. An
    InvalidValueError says that it is no name, or that the folder of sockets cannot be used, and a
    DuplicateNameError that another process holds it.
    """

    endpoint: str
    """Place at which the server has to listen."""
    secret: str
    """Password that it has to ask of clients; empty where only this user can reach the endpoint."""

    def __init__(self, name: str, source: str = "") -> None:
        self._stem = check_server_name(name) + (f"@{check_server_name(source, 'source')}" if source else "")
        self._folder = folder = runtime_folder()
        self._lock = _lock(folder, self._stem)
        if self._lock is None:
            what = f"A source {source!r} of the model server" if source else "A model server"
            raise DuplicateNameError(f"{what} {name!r} is running already. Use that one, or another name.")
        self.secret = ""
        if UNIX_SOCKETS:
            _discard(folder, self._stem)
            try:
                self.endpoint = _socket_endpoint(folder, self._stem)
            except InvalidValueError:
                self.release()
                raise
            return
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        self.secret = secrets.token_hex(16)
        path = folder / f"{self._stem}.json"
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        with open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w", encoding="utf-8") as file:
            json.dump({"endpoint": self.endpoint, "secret": self.secret}, file)

    def __enter__(self) -> Claim:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Give the name back, once the server no longer listens."""
        if self._lock is not None:
            _discard(self._folder, self._stem)
            _unlock(self._folder, self._stem, self._lock)
            self._lock = None


def check_server_name(name: str, what: str = "model server") -> str:
    """Return the name of a server or source if it can be one, else raise an InvalidValueError."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InvalidValueError(
            f"{name!r} is no name of a {what}: it has letters, digits, '_', '.' and '-', at most 60, and "
            "does not begin with '.' or '-'."
        )
    return name


def check_endpoint(endpoint: str) -> str:
    """Return an endpoint if it has the form of one, else raise an InvalidValueError."""
    if not _ENDPOINT.fullmatch(endpoint):
        raise InvalidValueError(
            f"{endpoint!r} is nothing to listen at: that is tcp/HOST:PORT or unixsock-stream/PATH."
        )
    return endpoint


def list_servers() -> list[str]:
    """Return the names of the model servers of this user that are running, sorted.

    What killed servers have left in the folder is removed.
    """
    try:
        folder = runtime_folder()
    except InvalidValueError:
        return []
    known = sorted({path.stem for path in folder.iterdir() if path.suffix in (".held", ".json")})
    return [stem for stem in known if _is_served(folder, stem) and _NAME.fullmatch(stem)]


def runtime_folder() -> Path:
    """Return the folder of sockets, which is made if it is not there.

    It is ``KINEVERSE_RUNTIME_DIR``, else ``kineverse`` in ``XDG_RUNTIME_DIR``, else a folder of this user's
    own in the folder for temporary files. If others can read or replace what is in it, that is an
    InvalidValueError.
    """
    chosen, runtime = os.environ.get("KINEVERSE_RUNTIME_DIR"), os.environ.get("XDG_RUNTIME_DIR")
    if chosen:
        path = Path(chosen).absolute()
    elif runtime and os.path.isabs(runtime) and os.path.isdir(runtime):
        path = Path(runtime) / "kineverse"
    else:
        user = os.geteuid() if hasattr(os, "geteuid") else "user"
        path = Path(tempfile.gettempdir()).absolute() / f"kineverse-{user}"
    try:
        PrivateFolder(path)
        if hasattr(os, "geteuid") and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise NotPrivateError("can be entered by others (chmod 700 mends that)")
    except NotPrivateError as error:
        reason = str(error)
    except OSError as error:
        reason = f"cannot be used ({error.strerror})"
    else:
        return path
    raise InvalidValueError(
        f"The folder for sockets of model servers, {path}, {reason}. KINEVERSE_RUNTIME_DIR chooses another."
    )


def _socket_endpoint(folder: Path, stem: str) -> str:
    path = os.fspath(folder / f"{stem}.sock")
    endpoint = f"unixsock-stream/{path}"
    size = len(os.fsencode(path))
    if size > _LONGEST_SOCKET or not _ENDPOINT.fullmatch(endpoint):
        what = f"has {size} bytes, more than {_LONGEST_SOCKET}" if size > _LONGEST_SOCKET else "has ? or #"
        raise InvalidValueError(
            f"No socket can be made at {path}: the path {what}. KINEVERSE_RUNTIME_DIR chooses another folder."
        )
    return endpoint


def _read_place(folder: Path, stem: str) -> tuple[str, str] | None:
    try:
        found = json.loads((folder / f"{stem}.json").read_text("utf-8"))
        return str(found["endpoint"]), str(found["secret"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


# -- locks ---------------------------------------------------------------------------------------------------


def _is_served(folder: Path, stem: str) -> bool:
    """Return True if a server holds a name; else remove what one has left.

    Without locks it stays, as it may be of a server that does not listen yet.
    """
    if fcntl is None:
        place = _read_place(folder, stem)
        return place is not None and _is_open(place[0])
    try:
        descriptor = os.open(folder / f"{stem}.held", _OPEN)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # those who look do not disturb each other
    except OSError:
        os.close(descriptor)
        return True
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _discard(folder, stem)
        _unlock(folder, stem, descriptor)
        return False
    os.close(descriptor)
    return False


def _lock(folder: Path, stem: str) -> int | None:
    """Return the descriptor of a file that this process holds alone; None if another does."""
    if fcntl is None:
        return None if _is_served(folder, stem) else -1
    path, late = folder / f"{stem}.held", time.monotonic() + _LOOK_SECONDS
    while True:
        descriptor = os.open(path, os.O_CREAT | _OPEN, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Who held it before may have removed it meanwhile, so that others would lock another file.
            if os.path.samestat(os.fstat(descriptor), os.stat(path, follow_symlinks=False)):
                return descriptor
        except OSError:
            if time.monotonic() > late:  # not one who only looks
                os.close(descriptor)
                return None
            time.sleep(0.005)
        os.close(descriptor)


def _unlock(folder: Path, stem: str, lock: int) -> None:
    if lock >= 0:
        with contextlib.suppress(OSError):
            os.unlink(folder / f"{stem}.held")
        os.close(lock)


def _discard(folder: Path, stem: str) -> None:
    for ending in _FILES:
        with contextlib.suppress(OSError):
            os.unlink(folder / (stem + ending))


def _is_open(endpoint: str) -> bool:
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    with contextlib.suppress(OSError, ValueError):
        socket.create_connection((host, int(port)), _LOOK_SECONDS).close()
        return True
    return False
