"""Keys of servers, relays and users: certificates of one authority, by which each shows the others its name.

A folder of keys has ``ca.pem``, the certificate of the authority, ``cert.pem``, that of the owner, and
``key.pem``, which only the owner may read. The common name of a certificate is the name of a user,
``relay NAME`` or ``model server``: names of users have no spaces, so nobody is taken for another kind. To its
clients, a relay is a model server, by ``server.pem``.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import os
import re
import secrets
import socket
import ssl
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from kineverse._extras import install_command
from kineverse.compilation.private_folder import NotPrivateError, PrivateFolder
from kineverse.errors import DuplicateNameError, FormatError, InvalidValueError, MissingDependencyError

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError:
    raise MissingDependencyError(
        f"Keys of model servers need the package cryptography: {install_command('exchange')}"
    ) from None

from .access import relay_name
from .address import check_server_name, split_endpoint
from .rights import FILE_NAME, Right, Rights
from .transport import SERVER

AUTHORITY, CERTIFICATE, LISTENING, KEY = "ca.pem", "cert.pem", "server.pem", "key.pem"
_SERVER: Final = "server"
_RIGHTS: Final = """\
# Who may do what: "see", "edit", or a list of prefixes below which one edits, such as ["kitchen/"].
# A server or relay reads this file when it starts.
[users]
"""

_HOST: Final = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(?:\.(?!-)[A-Za-z0-9-]{1,63})*")
_AUTHORITY_DAYS: Final = 3650
_EARLIER: Final = timedelta(hours=1)  # clocks of others may be late
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO
_SECONDS: Final = 2.0  # for a handshake that finds out why a connection was refused
_ALERT_SECONDS: Final = 0.5  # a server that refuses a certificate says so after the handshake


@dataclass(frozen=True)
class Keys:
    """Keys of a server, a relay or a user, from :meth:`read`; ``name`` is that in the certificate."""

    folder: Path
    name: str
    ends: datetime

    @classmethod
    def read(cls, folder: str | os.PathLike[str] | None = None) -> Keys:
        """Return the keys in a folder: by default ``KINEVERSE_KEYS``, else that of the user's configuration.

        If a file is missing, is none of its kind, does not belong to the others, or can be read by others
        although it is private, that is an InvalidValueError.
        """
        path = _default_folder() if folder is None else Path(folder).expanduser().absolute()
        missing = [name for name in (AUTHORITY, CERTIFICATE, KEY) if not os.path.isfile(path / name)]
        if missing:
            raise InvalidValueError(
                f"The keys in {path} are not complete: {' and '.join(missing)} missing. "
                + (
                    "Put those that you were given there, or name another folder in KINEVERSE_KEYS."
                    if folder is None
                    else "'kineverse keys FOLDER' makes them, in FOLDER/server and FOLDER/relays/NAME."
                )
            )
        _check_private(path / KEY)
        certificate = _load(path / CERTIFICATE, x509.load_pem_x509_certificate, "certificate")
        _load(path / AUTHORITY, x509.load_pem_x509_certificate, "certificate")
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(path / CERTIFICATE, path / KEY, "")
        except PermissionError as error:
            raise InvalidValueError(f"{path / KEY} cannot be read: {error.strerror}.") from None
        except (ssl.SSLError, ValueError):
            raise InvalidValueError(
                f"{path / KEY} is not the key of {path / CERTIFICATE}. Copy both from one folder."
            ) from None
        names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        return cls(path, str(names[0].value) if names else "", certificate.not_valid_after_utc)

    @property
    def authority(self) -> Path:
        """File of the authority's certificate."""
        return self.folder / AUTHORITY

    @property
    def certificate(self) -> Path:
        """File of the owner's certificate."""
        return self.folder / CERTIFICATE

    @property
    def listening(self) -> Path:
        """File of the certificate that clients are shown: the owner's, save for a relay."""
        path = self.folder / LISTENING
        return path if path.exists() else self.certificate

    @property
    def private_key(self) -> Path:
        """File of the owner's key."""
        return self.folder / KEY

    @property
    def user(self) -> str:
        """Name of the user; if these are the keys of a server or a relay, that is an InvalidValueError."""
        try:
            return check_server_name(self.name, "user")
        except InvalidValueError:
            raise InvalidValueError(
                f"The keys in {self.folder} are those of {self.name!r}, which is no user. Name the folder of "
                "a user in KINEVERSE_KEYS."
            ) from None

    @property
    def has_ended(self) -> bool:
        """True if the certificate has expired."""
        return self.ends <= datetime.now(UTC)

    @property
    def hosts(self) -> tuple[str, ...]:
        """Names and addresses of the hosts that the certificate is for."""
        certificate = _load(self.listening, x509.load_pem_x509_certificate, "certificate")
        with contextlib.suppress(x509.ExtensionNotFound, ValueError):
            found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            return tuple(str(name.value) for name in found)
        return ()


def read_listening(folder: str | os.PathLike[str], owner: str) -> tuple[Keys, Rights]:
    """Return the keys of a server or relay, and the rights beside them.

    Keys of another owner, or that have expired, are an InvalidValueError, and wrong rights a FormatError.
    """
    keys = Keys.read(folder)
    if not f"{keys.name} ".startswith(f"{owner} "):
        raise InvalidValueError(
            f"The keys in {keys.folder} are those of {keys.name!r}. Name the folder of the {owner}."
        )
    if keys.has_ended:
        raise InvalidValueError(
            f"The certificate in {keys.folder} expired on {keys.ends:%Y-%m-%d}. 'kineverse keys' makes "
            "another one with --renew."
        )
    return keys, Rights.read(keys.folder / FILE_NAME)


def _check_private(path: Path) -> None:
    """Raise an InvalidValueError if others can read a file, where that can be known."""
    if hasattr(os, "geteuid") and path.stat().st_mode & _OTHERS:
        raise InvalidValueError(
            f"Others can read {path}, which is private (its mode is {path.stat().st_mode & 0o777:o}): "
            f"chmod 600 mends that, and if somebody has read it, make new keys."
        )


# -- why a connection is refused -----------------------------------------------------------------------------

_UNTRUSTED: Final = "its certificate is of another authority than {ca}: it is a foreign server"
_ELSEWHERE: Final = (
    "its certificate is for another host than {host}: it is a foreign server, or the address is wrong"
)
_REASONS: Final[dict[int, str]] = {  # codes of OpenSSL
    **dict.fromkeys((18, 19, 20, 21), _UNTRUSTED),
    **dict.fromkeys((62, 64), _ELSEWHERE),
    26: "its certificate is that of a user, and of no server",
    9: "its certificate is not valid yet; look at the clocks of both computers",
    10: "its certificate has expired: its owner has to renew it",
}
_ALERTS: Final[dict[str, str]] = {
    "UNKNOWN_CA": "it does not know the authority of {cert}: those keys are for another server",
    "CERTIFICATE_EXPIRED": "{cert} has expired: ask for new keys",
    "CERTIFICATE_REQUIRED": "it wants a certificate",
    "WRONG_VERSION_NUMBER": "what answers there does not speak TLS",
}


def explain_refusal(endpoint: str, keys: Keys) -> str:
    """Return why the server at an endpoint refuses these keys, or they refuse it, as far as can be known.

    That is found by a handshake, so it is about the present, and takes up to two seconds.
    """
    host, port = split_endpoint(endpoint)
    context = ssl.create_default_context(cafile=keys.authority)
    context.load_cert_chain(keys.certificate, keys.private_key)
    reason = "it takes the keys, but is no model server, or busy"
    if keys.has_ended:
        reason = _ALERTS["CERTIFICATE_EXPIRED"]
    try:
        with (
            socket.create_connection((host, port), _SECONDS) as plain,
            context.wrap_socket(plain, server_hostname=host) as secured,
        ):
            secured.settimeout(_ALERT_SECONDS)
            with contextlib.suppress(TimeoutError):
                secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        reason = _REASONS.get(error.verify_code, f"its certificate is not valid ({error.verify_message})")
    except ssl.SSLError as error:
        alert = next((alert for alert in _ALERTS if alert in (error.reason or "")), "")
        reason = _ALERTS.get(alert, f"the connection was refused ({error.reason or error})")
    except TimeoutError:
        reason = f"nobody answers within {_SECONDS:g} s"
    except (OSError, OverflowError) as error:
        reason = f"nobody is there ({getattr(error, 'strerror', None) or error})"
    return f"{endpoint}: {reason.format(host=host, ca=keys.authority, cert=keys.certificate)}"


# -- making keys ---------------------------------------------------------------------------------------------


def make_keys(
    folder: str | os.PathLike[str],
    *,
    server: Sequence[str] = (),
    user: Sequence[str] = (),
    relay: Mapping[str, Sequence[str]] = MappingProxyType({}),
    days: float = 365.0,
    renew: bool = False,
) -> list[Path]:
    """Make keys of an authority in a folder, and return their folders.

    The folder has ``authority``, ``server``, ``users`` and ``relays``; what is not there is made. The server,
    which is named first of all, and the relays have names or IP addresses of hosts, by which clients reach
    them. New users may see, and new relays speak for all users: that is in the server's ``rights.toml``.
    The certificates are valid for a number of days. Those who have keys get new ones if that is said;
    otherwise that is a DuplicateNameError.
    """
    if not days <= _AUTHORITY_DAYS:
        raise InvalidValueError(f"days= is at most {_AUTHORITY_DAYS}, the time of an authority.")
    root = Path(folder).expanduser().absolute()
    wanted: dict[Path, tuple[str, Sequence[str]]] = {}
    if server:
        wanted[root / _SERVER] = SERVER, server
    elif not (root / _SERVER / FILE_NAME).exists():
        raise InvalidValueError(f"{root} has no server yet. Name its hosts with server=, too.")
    for name, places in relay.items():
        wanted[root / "relays" / check_server_name(name, "relay")] = relay_name(name), places
        if not places:
            raise InvalidValueError(
                f"The relay {name!r} needs the names of its hosts, by which clients reach it."
            )
    for name in user:
        wanted[root / "users" / check_server_name(name, "user")] = name, ()
    if not wanted:
        raise InvalidValueError("There is nobody to make keys for: name some with server=, user= or relay=.")
    for path, (_, places) in wanted.items():
        _alternatives(places)
        if (path / KEY).exists() and not renew:
            raise DuplicateNameError(f"{path} has keys already. renew= makes new ones in their place.")
    authority = _Authority(root / "authority")
    for path in wanted:
        _make_folder(path)
    _add_rights(root, user, relay)
    for path, (name, places) in wanted.items():
        authority.issue(path, name, places, days)
    return [*wanted]


def _add_rights(root: Path, users: Iterable[str], relays: Iterable[str]) -> None:
    """Add those who are not in the server's rights, and write those of a relay, which are a part of them."""
    path = root / _SERVER / FILE_NAME
    there = Rights.read(path) if path.exists() else Rights()
    text = path.read_text("utf-8") if path.exists() else _RIGHTS
    new = [user for user in dict.fromkeys(users) if user not in there.users]
    text = _add_lines(text, "users", [f'{_key(user)} = "see"' for user in new])
    spoken = json.dumps([*there.users, *new])
    lines = [f"{_key(relay)} = {spoken}" for relay in relays if relay not in there.relays]
    rights = _write_rights(path, _add_lines(text, "relays", lines))
    for relay in relays:
        lines = [f"{_key(user)} = {_format(rights.users[user])}" for user in rights.relays[relay]]
        _write_rights(root / "relays" / relay / FILE_NAME, _add_lines(_RIGHTS, "users", lines))


def _add_lines(text: str, table: str, lines: Sequence[str]) -> str:
    """Return a text in TOML with lines at the beginning of a table."""
    if not lines:
        return text
    head = re.search(rf"^\[{table}\][ \t]*(?:#.*)?$", text, re.MULTILINE)
    if head is None:
        return "\n".join([text.rstrip("\n"), f"\n[{table}]", *lines, ""])
    return "\n".join([text[: head.end()], *lines]) + text[head.end() :]


def _key(name: str) -> str:
    return json.dumps(name) if "." in name else name


def _format(right: Right) -> str:
    if right.may_edit_all:
        return '"edit"'
    return json.dumps(right.prefixes) if right.prefixes else '"see"'


def _write_rights(path: Path, text: str) -> Rights:
    part = path.with_name(f".{path.name}.new")
    try:
        _write_private(part, text.encode())
        rights = Rights.read(part)
        part.replace(path)
    except FormatError as error:
        raise InvalidValueError(f"Nobody can be added to {path}: write it by hand. {error}") from None
    finally:
        part.unlink(missing_ok=True)
    return rights


class _Authority:
    """Authority in a folder, which is made if it is not there."""

    def __init__(self, folder: Path) -> None:
        if not (folder / AUTHORITY).exists():
            self.key = _make_key()
            name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"Kineverse {secrets.token_hex(4)}")])
            usage = dict.fromkeys(_USAGES, False) | {"key_cert_sign": True, "crl_sign": True}
            builder = (
                _builder(name, name, self.key.public_key(), datetime.now(UTC) + timedelta(_AUTHORITY_DAYS))
                .add_extension(x509.BasicConstraints(True, 0), critical=True)
                .add_extension(x509.KeyUsage(**usage), critical=True)
            )
            self.certificate = builder.sign(self.key, hashes.SHA256())
            _write(folder, {KEY: self.key, AUTHORITY: self.certificate})
            return
        if not (folder / KEY).exists():
            raise InvalidValueError(
                f"{folder / KEY} is missing, so nothing can be signed. Put it back, or take a new folder."
            )
        _check_private(folder / KEY)
        self.certificate = _load(folder / AUTHORITY, x509.load_pem_x509_certificate, "certificate")
        self.key = _load(
            folder / KEY, lambda data: serialization.load_pem_private_key(data, None), "private key"
        )
        if self.certificate.not_valid_after_utc <= datetime.now(UTC):
            raise InvalidValueError(f"The authority in {folder} has expired. Take a new folder.")

    def issue(self, folder: Path, name: str, hosts: Sequence[str], days: float) -> None:
        """Write the keys of an owner: with hosts it can be a server, and with another name a client."""
        key = _make_key()
        files = {KEY: key, AUTHORITY: self.certificate}
        if hosts:
            files[CERTIFICATE if name == SERVER else LISTENING] = self._sign(key, SERVER, hosts, days)
        if name != SERVER:
            files[CERTIFICATE] = self._sign(key, name, (), days)
        _write(folder, files)

    def _sign(self, key: Any, name: str, hosts: Sequence[str], days: float) -> x509.Certificate:
        use = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
        usage = dict.fromkeys(_USAGES, False) | {"digital_signature": True}
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        end = min(datetime.now(UTC) + timedelta(days), self.certificate.not_valid_after_utc)
        builder = (
            _builder(subject, self.certificate.subject, key.public_key(), end)
            .add_extension(x509.BasicConstraints(False, None), critical=True)
            .add_extension(x509.KeyUsage(**usage), critical=True)
            .add_extension(x509.ExtendedKeyUsage([use]), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), critical=False
            )
        )
        if hosts:
            builder = builder.add_extension(x509.SubjectAlternativeName(_alternatives(hosts)), critical=False)
        certificate: x509.Certificate = builder.sign(self.key, hashes.SHA256())
        return certificate


_USAGES: Final = (
    "digital_signature",
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "key_cert_sign",
    "crl_sign",
    "encipher_only",
    "decipher_only",
)


def _make_key() -> Any:
    return ec.generate_private_key(ec.SECP256R1())


def _builder(subject: Any, issuer: Any, key: Any, end: datetime) -> Any:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(datetime.now(UTC), end) - _EARLIER)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _alternatives(hosts: Sequence[str]) -> list[Any]:
    found: list[x509.GeneralName] = []
    for host in hosts:
        try:
            found.append(x509.IPAddress(ipaddress.ip_address(host.strip("[]"))))
            continue
        except ValueError:
            if not _HOST.fullmatch(host) or len(host) > 253:
                raise InvalidValueError(
                    f"{host!r} is neither the name of a host nor an IP address."
                ) from None
        found.append(x509.DNSName(host))
    return found


def _write(folder: Path, files: dict[str, Any]) -> None:
    """Write certificates and keys into a folder, each as a whole, for this user only."""
    pem = serialization.Encoding.PEM
    _make_folder(folder)
    try:
        for name, content in files.items():
            if name == KEY:
                data = content.private_bytes(
                    pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
                )
            else:
                data = content.public_bytes(pem)
            _write_private(folder / name, data)
    except OSError as error:
        raise InvalidValueError(f"{folder} cannot be written: {error.strerror}.") from None


def _make_folder(folder: Path) -> None:
    try:
        PrivateFolder(folder)
    except NotPrivateError as error:
        raise InvalidValueError(f"The folder {folder} {error}. Keys need one of their own.") from None
    except OSError as error:
        raise InvalidValueError(f"{folder} cannot be written: {error.strerror}.") from None


def _write_private(path: Path, data: bytes) -> None:
    """Write a file that only this user can read, as a whole."""
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with open(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as file:
            file.write(data)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _load(path: Path, load: Any, what: str) -> Any:
    try:
        return load(path.read_bytes())
    except OSError as error:
        raise InvalidValueError(f"{path} cannot be read: {error.strerror}.") from None
    except (ValueError, TypeError):
        raise InvalidValueError(f"{path} is no {what} in PEM.") from None


def _default_folder() -> Path:
    chosen, configuration = os.environ.get("KINEVERSE_KEYS"), os.environ.get("XDG_CONFIG_HOME", "")
    if chosen:
        return Path(chosen).expanduser().absolute()
    home = Path(configuration) if os.path.isabs(configuration) else Path("~/.config").expanduser()
    return home / "kineverse" / "keys"
