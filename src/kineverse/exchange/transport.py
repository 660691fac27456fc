"""Questions, messages and signs of life between processes: the one module that uses Zenoh.

A server listens, clients connect to it, and everything goes through it. There is no discovery, and no port is
open unless one is asked for. What arrives waits in channels, from which threads of the library take it: Zenoh
calls nothing here, so that a script ends although it has closed nothing.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import re
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, TypeVar

from kineverse._extras import install_command
from kineverse.errors import InvalidValueError, MissingDependencyError, OfflineError

from .address import check_endpoint, is_secured, list_endpoints

if TYPE_CHECKING:
    from .keys import Keys

Use: TypeAlias = Literal["ask", "find", "answer", "read", "publish", "show", "watch"]
"""Uses of a key: to ask questions, find who answers them, and answer them; to read and to publish messages;
to show a sign of life, and to watch those of others."""

SERVER: Final = "model server"  # common name in the certificate that a server or relay listens with
LEASE: Final = 1.0  # time after which a process that says nothing counts as gone [s]
SLOWEST: Final = 16_384  # slowest connection that is borne [byte/s]
LONGEST: Final = 60.0  # time that a message may take on a slow connection [s]

_USER: Final = "kineverse"
_MOST_QUESTIONS: Final = 10_000
_END_SECONDS: Final = 0.6
_OPEN_SECONDS: Final = 3.0  # for a server that is held up
_PART: Final = 16_384  # most bytes of an answer that are sent in one message
_MOST_PARTS: Final = 8_192


Value = TypeVar("Value")


class NoAnswerError(Exception):
    """Nobody is there, or has answered in time; or the transport is closed."""


@dataclass(frozen=True)
class Grant:
    """Permission to use some keys, for those with certain names in their certificates.

    If the names are None, it is for everybody with a certificate of the authority.
    """

    use: Use
    keys: tuple[str, ...]
    names: tuple[str, ...] | None


class _Entrances:
    """Calls of Zenoh that are under way in this process.

    A thread that comes back from one while the interpreter ends would abort the process: Zenoh's frames
    cannot be unwound. So when the process ends all transports are closed first, and no call begins after.
    The end of an object of Zenoh is such a call, too; see :class:`_Owner`.
    """

    def __init__(self) -> None:
        self.left: list[Any] = []  # objects of Zenoh that nobody may end any more
        self._inside: list[None] = []  # append and pop are atomic
        self._ended = False
        self.is_used = self.is_forked = False
        self.transports: weakref.WeakSet[Transport] = weakref.WeakSet()
        atexit.register(self._end)
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._forbid)

    def __enter__(self) -> None:
        self._inside.append(None)
        if self._ended:
            self._inside.pop()
            raise NoAnswerError("The process ends.")

    def __exit__(self, *_: object) -> None:
        self._inside.pop()

    def _forbid(self) -> None:
        """Begin no call in a forked process: the threads of Zenoh are not in it, its sockets are shared."""
        if self.is_used:
            self._ended = self.is_forked = True
            self._inside.clear()

    def _end(self) -> None:
        for transport in list(self.transports):
            transport.close()
        self._ended = True
        late = time.monotonic() + _END_SECONDS
        while self._inside and time.monotonic() < late:
            time.sleep(0.001)


_call = _Entrances()


def check_not_forked() -> None:
    """Raise an OfflineError in a process that was forked from one that had a connection."""
    if _call.is_forked:
        raise OfflineError(
            "This process was forked from one that has used a model server, so it cannot use one. Start "
            "processes by multiprocessing's method 'spawn' or 'forkserver', and load the model in them."
        )


class _Owner:
    """Owner of an object of Zenoh, which ends it in a call like any other."""

    _owned: Any = None

    def __init__(self, owned: Any) -> None:
        self._owned = owned

    def __del__(self) -> None:
        try:
            with _call:
                self._owned = None
        except NoAnswerError:
            _call.left.append(self._owned)


class Channel(_Owner):
    """Subscription, and what has arrived for it, oldest first.

    The oldest is dropped where too much waits, so a slow reader holds up nobody.
    """

    def __init__(self, owned: Any) -> None:
        super().__init__(owned)
        self._lock = threading.Lock()  # two threads in the object at once are an error of Zenoh

    def _wait(self, read: Callable[[Any], Value]) -> Value | None:
        """Return what is read from the next thing that arrives, None after the end."""
        try:
            with _call:
                with self._lock:
                    channel = self._owned.handler
                try:
                    return read(channel.recv())
                finally:
                    del channel
        except (NoAnswerError, _zenoh().ZError):
            return None

    def close(self) -> None:
        """End the subscription: those who wait go on, and get nothing more."""
        with contextlib.suppress(NoAnswerError, _zenoh().ZError), _call, self._lock:
            self._owned.undeclare()


class Messages(Channel):
    """Payloads of messages, as bytes; iterating waits for the next."""

    def __iter__(self) -> Iterator[bytes]:
        while (payload := self._wait(lambda sample: bytes(sample.payload))) is not None:
            yield payload


class LifeSigns(Channel):
    """Keys of tokens that come, with True, and go, with False; those that are there come first."""

    def __iter__(self) -> Iterator[tuple[str, bool]]:
        put = _zenoh().SampleKind.PUT
        while (sign := self._wait(lambda sample: (str(sample.key_expr), sample.kind == put))) is not None:
            yield sign


class Question(_Owner):
    """Question, to be answered once; the asker of one that is dropped hears at once that nobody answers."""

    def __init__(self, query: Any) -> None:
        super().__init__(query)
        payload, self.key = query.payload, str(query.key_expr)
        self.payload = b"" if payload is None else bytes(payload)

    def answer(self, payload: bytes) -> None:
        """Send the answer; an asker who is gone gets none.

        A long one is sent in parts by a thread of its own: its asker may be behind a slow connection, and
        Zenoh holds up others while it waits to send a message.
        """
        if len(payload) > _PART:
            threading.Thread(target=self._send, args=(payload,), name="kineverse-answer", daemon=True).start()
        else:
            self._send(payload)

    def _send(self, payload: bytes) -> None:
        with contextlib.suppress(NoAnswerError, _zenoh().ZError), _call:
            size = str(len(payload)) if len(payload) > _PART else None
            for start in range(0, max(1, len(payload)), _PART):
                self._owned.reply(self._owned.key_expr, payload[start : start + _PART], attachment=size)
            self._owned.drop()  # else the asker waits for more


class Questions(Channel):
    """Questions that have come in; iterating waits for the next."""

    def __iter__(self) -> Iterator[Question]:
        while (question := self._wait(Question)) is not None:
            yield question

    def take(self, most: int, seconds: float) -> list[Question]:
        """Wait for a question and return it with those that wait behind it; none after the end.

        Taking stops at the number ``most``, and after so many seconds.
        """
        first = self._wait(Question)
        if first is None:
            return []
        result, late = [first], time.monotonic() + seconds
        with contextlib.suppress(NoAnswerError, _zenoh().ZError), _call:
            with self._lock:
                channel = self._owned.handler
            while len(result) < most and time.monotonic() <= late:
                query = channel.try_recv()
                if query is None:
                    break
                result.append(Question(query))
                del query
            del channel
        return result


class Token(_Owner):
    """Sign of life, which others see until it is closed, this process ends, or its connection is cut."""

    def close(self) -> None:
        """Take the sign back."""
        with contextlib.suppress(NoAnswerError, _zenoh().ZError), _call:
            self._owned.undeclare()


class Transport(_Owner):
    """Connection of this process to others, made by :meth:`serve` or :meth:`connect`.

    Endpoints are ``unixsock-stream/PATH``, ``tcp/HOST:PORT`` or ``tls/HOST:PORT``. All methods may be called
    in any thread. After :meth:`close` they raise :class:`NoAnswerError`, and publishing does nothing.
    """

    def __init__(self, settings: dict[str, object]) -> None:
        check_not_forked()
        zenoh = _zenoh()
        config = zenoh.Config()
        for path, value in {**_SETTINGS, **settings}.items():
            config.insert_json5(path, json.dumps(value))
        _call.is_used = True
        with _call:
            super().__init__((zenoh.open(config), zenoh.CancellationToken()))
        self._drop, self._block = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
        self._all, self._error = zenoh.ConsolidationMode.NONE, zenoh.ZError
        _call.transports.add(self)

    @classmethod
    def serve(
        cls,
        endpoints: Sequence[str],
        secret: str = "",
        *,
        keys: Keys | None = None,
        grants: Sequence[Grant] = (),
        servers: Sequence[str] = (),
    ) -> Transport:
        """Listen at endpoints, for clients that know the secret if there is one.

        At endpoints of TLS clients need a certificate of the authority in the folder of keys, and may do what
        they are granted. All others may do everything. With ``servers`` it is a relay, with keys: it connects
        to one of them as soon as it is there, which may do everything. An endpoint that is taken, or none to
        listen at, is an InvalidValueError.
        """
        for endpoint in endpoints:
            check_endpoint(endpoint)
        settings = {"mode": "router", "listen/endpoints": list(endpoints), "listen/exit_on_failure": True}
        if servers:
            settings |= {"connect/endpoints": list(servers), "connect/timeout_ms": -1, **_RETRY}
            settings |= {"connect/exit_on_failure": False, **_NETWORK}
        if keys is not None and any(map(is_secured, endpoints)):
            trusted: dict[str, object] = (
                _A_SERVER if servers else {"link_protocols": ["unixsock-stream", "tcp"]}
            )
            settings |= {**_tls(keys, listens=True), **_access_control(trusted, grants)}
        with contextlib.ExitStack() as stack:
            if secret:
                folder = stack.enter_context(tempfile.TemporaryDirectory())
                passwords = os.path.join(folder, "users")
                descriptor = os.open(passwords, os.O_CREAT | os.O_WRONLY, 0o600)
                with open(descriptor, "w", encoding="utf-8") as file:
                    file.write(f"{_USER}:{secret}\n")
                settings |= {**_credentials(secret), "transport/auth/usrpwd/dictionary_file": passwords}
            try:
                return cls(settings)
            except _zenoh().ZError as error:
                reason = re.sub(r"\s+at /\S+?\.rs:\d+\.?", "", str(error)).strip().rstrip(".")  # no places
                named = " and ".join([e for e in endpoints if e in reason] or endpoints)
                raise InvalidValueError(
                    f"Cannot listen at {named}: {reason}. Choose another endpoint."
                ) from None

    @classmethod
    def connect(
        cls, endpoint: str, secret: str = "", timeout: float = 0.0, *, keys: Keys | None = None
    ) -> Transport:
        """Connect to a server; a connection that is cut is made again as soon as there is a server.

        Two endpoints with a comma between them are tried in turn, also later; TLS needs a folder of keys. If
        no server is there after the timeout [s], or it wants another secret or other keys, that is a
        :class:`NoAnswerError`.
        """
        settings = {
            "mode": "client",
            "connect/endpoints": list_endpoints(endpoint),
            "connect/exit_on_failure": True,
            "connect/timeout_ms": round(1e3 * timeout),
            **_RETRY,
            **({} if endpoint.startswith("unixsock") else _NETWORK),
            **_credentials(secret),
            # Zenoh takes certificates of public authorities as well, which are those of no model server.
            **({} if keys is None else _tls(keys) | _access_control(_A_SERVER)),
        }
        try:
            return cls(settings)
        except _zenoh().ZError:
            raise NoAnswerError(f"No server answers at {endpoint}.") from None

    def ask(self, key: str, payload: bytes, timeout: float, *, gives_way: bool = False) -> bytes:
        """Return the answer to a question.

        One that gives way lets other messages of the same connection overtake it and its answer. Raise a
        :class:`NoAnswerError` at once if nobody is there who answers, or as soon as a connection on the way
        is cut; else after the timeout [s]. So a question that was lost need not be asked again before.
        """
        priorities = _zenoh().Priority
        channel: Any = _zenoh().handlers.FifoChannel(_MOST_PARTS)  # a ring would lose the answer at its end
        try:
            with _call:
                session, cancelled = self._owned
                replies = session.get(
                    key,
                    channel,
                    payload=payload,
                    timeout=timeout,
                    consolidation=self._all,  # an answer is handed over when it comes, not when all have come
                    congestion_control=self._block,
                    priority=priorities.DATA_LOW if gives_way else priorities.DATA,
                    cancellation_token=cancelled,
                )
                answer = _join(replies)
                del replies, session, cancelled
        except (self._error, ValueError):
            raise NoAnswerError(f"Nobody answers {key}.") from None
        if answer is None:
            raise NoAnswerError(f"No answer from {key} within {timeout:g} s.")
        return answer

    def answers(self, key: str) -> Questions:
        """Return the questions for a key, all of which this process answers."""
        with self._declaring():
            return Questions(self._owned[0].declare_queryable(key, _ring(_MOST_QUESTIONS), complete=True))

    def publish(self, key: str, payload: bytes) -> None:
        """Send a message to the subscribers of a key.

        It waits for nobody: one who does not keep up loses messages. The others get them in order.
        """
        with contextlib.suppress(NoAnswerError, self._error), _call:
            self._owned[0].put(key, payload, congestion_control=self._drop)

    def subscribe(self, key: str, most: int = 10_000) -> Messages:
        """Return the messages of a key; of those that wait, the newest ``most`` are kept."""
        with self._declaring():
            return Messages(self._owned[0].declare_subscriber(key, _ring(most)))

    def alive(self, key: str) -> Token:
        """Show that this process is there for as long as the token is kept and not closed."""
        with self._declaring():
            return Token(self._owned[0].liveliness().declare_token(key))

    def is_alive(self, key: str, timeout: float) -> bool:
        """Return whether there is a sign of life of a key, in which ``*`` stands for any part."""
        try:
            with _call:
                signs = self._owned[0].liveliness().get(key, timeout=timeout, handler=_ring(1))
                found = signs.recv().ok is not None
                del signs
        except (NoAnswerError, self._error):
            return False
        return found

    def watch_alive(self, key: str) -> LifeSigns:
        """Return the signs of life of a key, in which ``*`` stands for any part between slashes."""
        with self._declaring():
            return LifeSigns(
                self._owned[0].liveliness().declare_subscriber(key, _ring(_MOST_QUESTIONS), history=True)
            )

    def close(self) -> None:
        """Close the connection and all that was made with it."""
        with contextlib.suppress(NoAnswerError, self._error), _call:
            self._owned[1].cancel()
            self._owned[0].close()

    @contextlib.contextmanager
    def _declaring(self) -> Iterator[None]:
        try:
            with _call:
                yield
        except self._error:
            raise NoAnswerError("The transport is closed.") from None


_SETTINGS: Final[dict[str, object]] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # a server would wait for others to find, half a second
    "transport/unicast/open_timeout": round(1e3 * _OPEN_SECONDS),
    "transport/shared_memory/enabled": False,  # files of it outlive a process that is killed
    "transport/link/tx/lease": round(1e3 * LEASE),
    "transport/link/tx/queue/size/data": 16,  # batches of 64 kB that wait for a reader before messages drop
    # Time that a message may take on a slow connection. That to one who reads nothing ends with the lease.
    "transport/link/tx/queue/congestion_control/block/wait_before_close": round(1e6 * LONGEST),
}
# A batch has to arrive within the lease, as nothing else is a sign of life meanwhile.
_NETWORK: Final[dict[str, object]] = {"transport/link/tx/batch_size": round(LEASE * SLOWEST)}
_RETRY: Final[dict[str, object]] = {
    "connect/retry": {"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 2},
}

_A_SERVER: Final[dict[str, object]] = {"cert_common_names": [SERVER]}

# Messages of Zenoh that a client sends to this process (ingress) and gets from it (egress) for a use.
_FLOWS: Final[Mapping[Use, Mapping[str, Sequence[str]]]] = {
    "ask": {"ingress": ["query"], "egress": ["reply"]},
    "find": {"egress": ["declare_queryable"]},
    "answer": {"ingress": ["declare_queryable", "reply"], "egress": ["query"]},
    "read": {"ingress": ["declare_subscriber"], "egress": ["put"]},
    "publish": {"ingress": ["put"], "egress": ["declare_subscriber"]},
    "show": {
        "ingress": ["liveliness_token"],
        "egress": ["declare_liveliness_subscriber", "liveliness_query"],
    },
    "watch": {
        "ingress": ["declare_liveliness_subscriber", "liveliness_query"],
        "egress": ["liveliness_token"],
    },
}


def _tls(keys: Keys, listens: bool = False) -> dict[str, object]:
    own = {"connect": keys.certificate} | ({"listen": keys.listening} if listens else {})
    return {
        "transport/link/tls": {
            "root_ca_certificate": str(keys.authority),
            **{f"{side}_certificate": str(certificate) for side, certificate in own.items()},
            **{f"{side}_private_key": str(keys.private_key) for side in own},
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
    }


def _access_control(trusted: dict[str, object], grants: Sequence[Grant] = ()) -> dict[str, object]:
    """Return rules by which the trusted may do everything, others what is granted, and nothing else."""
    everything = sorted({message for flows in _FLOWS.values() for some in flows.values() for message in some})
    rules: list[dict[str, object]] = []
    subjects: list[dict[str, object]] = []
    policies: list[dict[str, object]] = []

    def allow(subject: dict[str, object], flows: Mapping[str, Sequence[str]], keys: Sequence[str]) -> None:
        name = f"grant {len(subjects)}"
        granted = [_rule(f"{name} {flow}", flow, messages, keys) for flow, messages in flows.items()]
        rules.extend(granted)
        subjects.append({"id": name, **subject})
        policies.append({"rules": [rule["id"] for rule in granted], "subjects": [name]})

    allow(trusted, {"ingress": everything, "egress": everything}, ["**"])
    for grant in grants:
        if grant.names is None:
            allow({"link_protocols": ["tls"]}, _FLOWS[grant.use], grant.keys)
        elif grant.names:
            allow({"cert_common_names": [*grant.names]}, _FLOWS[grant.use], grant.keys)
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        }
    }


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, object]:
    return {
        "id": name,
        "permission": "allow",
        "messages": [*messages],
        "flows": [flow],
        "key_exprs": [*keys],
    }


def _credentials(secret: str) -> dict[str, object]:
    if not secret:
        return {}
    return {"transport/auth/usrpwd/user": _USER, "transport/auth/usrpwd/password": secret}


def _join(replies: Any) -> bytes | None:
    """Return an answer from its parts, each of which comes with the size of all; None for an error."""
    parts, size = list[bytes](), 0
    while not parts or size > len(parts) * _PART:
        sample = replies.recv().ok
        if sample is None:
            return None
        size = 0 if sample.attachment is None else int(bytes(sample.attachment))
        parts.append(bytes(sample.payload))
    return b"".join(parts)


def _ring(most: int) -> Any:
    return _zenoh().handlers.RingChannel(most)


@cache
def _zenoh() -> Any:
    try:
        import zenoh
    except ImportError:
        raise MissingDependencyError(
            f"Model servers need the package eclipse-zenoh: {install_command('exchange')}"
        ) from None
    return zenoh
