"""The web server behind the page: on this computer only, and silent."""

from __future__ import annotations

import contextlib
import io
import socket
from typing import Any

from kineverse.errors import MissingExtraError, ValueRejectedError
from kineverse.installation import install_command

HOST = "127.0.0.1"
PREFERRED_PORT = 8080


def start(port: int | None = None, label: str = "") -> Any:
    """Start a viser server that only this computer can reach.

    Parameters
    ----------
    port
        The port, 0 for any free one; None for 8080, or any free one if that is taken.
    label
        The title of the page.

    Raises
    ------
    MissingExtraError
        If viser is not installed.
    ValueRejectedError
        If the given port is taken or not a port.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError(f"the page in the browser needs viser: {install_command('view')}") from error

    class LocalServer(viser.ViserServer):
        """A server that cannot be told, by whoever opens the page, to publish itself on the internet."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    with quiet():
        return LocalServer(host=HOST, port=_free_port(port), label=label, verbose=False)


def stop(server: Any) -> None:
    """Stop a server, and wait until it has let go of its port."""
    with quiet():
        server.stop()


@contextlib.contextmanager
def quiet() -> Any:
    """Keep a library from printing: standard output belongs to the caller."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def _free_port(port: int | None) -> int:
    if port is not None and not 0 <= port <= 65535:
        raise ValueRejectedError(f"{port} is not a port; ports are numbers from 0 (any free one) to 65535")
    wanted = [PREFERRED_PORT, 0] if port is None else [port]
    for candidate in wanted:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, candidate))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise ValueRejectedError(f"port {port} is taken; leave --port away to get a free one")
