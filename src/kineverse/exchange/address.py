"""Addresses of model servers, and the folder in which those of this user are found.

A server ``NAME`` listens at the socket ``NAME.sock`` in a folder that only its user can enter; where there
are no Unix sockets, at a port of this computer, which stands with a secret in ``NAME.json``. While it runs it
holds a lock on ``NAME.held``, which ends with its process: nobody takes what a killed server has left for a
server.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import os
import re
import secrets
import socket
import stat
import tempfile
import time
from collections.abc import Iterable
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
_PLACE: Final = r"/(?:[^/\s?#:,]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}"
_ENDPOINT: Final = re.compile(rf"unixsock-stream/[^?#]+|(?:tcp|tls){_PLACE}")
_ENDPOINTS: Final = re.compile(rf"{_ENDPOINT.pattern}|tcp{_PLACE},tcp{_PLACE}|tls{_PLACE},tls{_PLACE}")
_LONGEST_SOCKET: Final = 103  # bytes of the path; systems allow 103 or 107
_FILES: Final = (".sock", ".sock.lock", ".json")  # the second is Zenoh's
_LOOK_SECONDS: Final = 0.1
_OPEN: Final = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)


@dataclass(frozen=True)
class Address:
    """Address of a model server: ``live:NAME``, ``live:ENDPOINT/NAME`` or ``live:ENDPOINT,ENDPOINT/NAME``."""

    name: str
    endpoint: str = ""
    """``tls/HOST:PORT`` or ``tcp/HOST:PORT``, or two of them, or ``unixsock-stream/PATH``; else empty."""

    @classmethod
    def parse(cls, text: str) -> Address:
        """Return the address that a text is; if it is none, that is a FormatError."""
        endpoint, _, name = text.removeprefix(SCHEME).rpartition("/")
        if not text.startswith(SCHEME) or (endpoint and not _ENDPOINTS.fullmatch(endpoint)):
            raise FormatError(
                f"{text!r} is no address of a model server. It is {SCHEME}NAME, {SCHEME}tls/HOST:PORT/NAME, "
                f"{SCHEME}tcp/HOST:PORT/NAME or {SCHEME}unixsock-stream/PATH/NAME. Two places with a comma "
                f"between them, {SCHEME}tls/HOST:PORT,tls/HOST:PORT/NAME, are tried in turn."
            )
        if endpoint.startswith("tls/") and "[" in endpoint:  # Zenoh takes no such names of a server
            raise FormatError(
                f"{text!r} has an IPv6 address, and certificates are of names. Write the name of the "
                "host, such as one in /etc/hosts."
            )
        try:
            return cls(check_server_name(name), endpoint)
        except InvalidValueError as error:
            raise FormatError(f"{text!r} is no address of a model server. {error}") from None

    def __str__(self) -> str:
        return f"{SCHEME}{self.endpoint}/{self.name}" if self.endpoint else SCHEME + self.name

    @property
    def is_secured(self) -> bool:
        """True if the server is reached by TLS, so that keys are needed."""
        return is_secured(self.endpoint)

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
            f"{endpoint!r} is nothing to listen at: that is tls/HOST:PORT, tcp/HOST:PORT or "
            "unixsock-stream/PATH."
        )
    return endpoint


def check_protected(endpoints: Iterable[str], keys: object, insecure: bool) -> None:
    """Raise an InvalidValueError unless endpoints for other computers are those of TLS, and have keys."""
    given = [*endpoints]
    secured = [one for one in given if is_secured(one)]
    reached = [one for one in given if is_open_to_others(one)]
    if reached and not insecure:
        raise InvalidValueError(
            f"Whoever reaches {reached[0]} from another computer could read and edit everything. Listen at "
            f"{reached[0].replace('tcp', 'tls', 1)} with keys=, which 'kineverse keys' makes, or say so "
            "with insecure=."
        )
    if secured and keys is None:
        raise InvalidValueError(
            f"{secured[0]} needs keys=, a folder with the keys of the server: 'kineverse keys' makes one."
        )
    if secured and not UNIX_SOCKETS:
        raise InvalidValueError(f"{secured[0]} needs a system with Unix sockets.")
    if keys is not None and not secured:
        raise InvalidValueError("keys= are for an endpoint of TLS: add tls/HOST:PORT to listen=.")


def is_secured(endpoint: str) -> bool:
    """Return True for an endpoint of TLS."""
    return endpoint.startswith("tls/")


def is_open_to_others(endpoint: str) -> bool:
    """Return True if other computers can reach an endpoint, and nothing protects it."""
    if not endpoint.startswith("tcp/"):
        return False
    host, _ = split_endpoint(endpoint)
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def list_endpoints(text: str) -> list[str]:
    """Return the endpoints in an address, each of its own."""
    return [text] if text.startswith("unixsock-stream/") else text.split(",")


def split_endpoint(endpoint: str) -> tuple[str, int]:
    """Return host, without brackets, and port of an endpoint of TCP or TLS."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def list_servers() -> list[str]:
    """Return the names of the model servers of this user that are running, sorted.

    What killed servers have left in the folder is removed.

    Examples
    --------
    >>> server = kv.exchange.serve("kitchen", name="doc-list")
    >>> "doc-list" in kv.exchange.list_servers()
    True
    >>> server.close()
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
    with contextlib.suppress(OSError, ValueError, OverflowError):
        socket.create_connection(split_endpoint(endpoint), _LOOK_SECONDS).close()
        return True
    return False
