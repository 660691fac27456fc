"""TCP proxy between clients and a server: it lets through, slows down, or cuts."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
from collections.abc import Callable, Coroutine
from contextlib import closing, suppress
from typing import Any

CUTS = ("silent", "reset")
"""Nothing gets through any more, neither data nor the end of a connection; or connections are reset."""
_CHUNK = 65_536
_WAITING = 100
_RESET = struct.pack("ii", 1, 0)


class Proxy:
    """Proxy that listens at a port of this computer, in a thread; it is closed by :func:`contextlib.closing`.

    Attributes
    ----------
    port
        Port at which it listens.
    delay
        Time that bytes take in either direction [s].
    rate
        Most bytes in a second in either direction of a connection; 0 for any number.
    up, down
        Number of bytes from clients to the server, and back.
    """

    def __init__(self, port: int, delay: float = 0.0, rate: float = 0.0) -> None:
        self._server, self.delay, self.rate = port, delay, rate
        self.up = self.down = 0
        self._loop = asyncio.new_event_loop()
        self._through = asyncio.Event()
        self._pairs: set[asyncio.Task[None]] = set()
        self._resets = False
        self._fillers: list[socket.socket] = []
        self._listener = _socket()
        self._listener.bind(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self.heal()

    def heal(self) -> None:
        """Let through, also what has waited on connections that both ends still have."""
        self._do(self._heal())

    def cut(self, how: str) -> None:
        """Cut all connections, and refuse new ones; how: one of ``CUTS``."""
        self._do(self._reset() if how == "reset" else self._fall_silent())

    def close(self) -> None:
        """End all connections."""
        self._do(self._reset())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        for one in (self._listener, *self._fillers):
            one.close()

    def _do(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _heal(self) -> None:
        self._listener.listen(_WAITING)
        self._resets = False
        self._through.set()
        self._loop.add_reader(self._listener, self._accept)
        while self._fillers:
            self._fillers.pop().close()

    async def _fall_silent(self) -> None:
        """Stop reading, and fill the queue of new connections, so that the system drops who knocks."""
        self._through.clear()
        self._loop.remove_reader(self._listener)
        self._listener.listen(0)
        self._fillers.append(_socket())
        with suppress(BlockingIOError):
            self._fillers[-1].connect(("127.0.0.1", self.port))

    async def _reset(self) -> None:
        self._resets = True
        for pair in self._pairs:
            pair.cancel()
        await asyncio.gather(*self._pairs, return_exceptions=True)

    def _accept(self) -> None:
        with suppress(BlockingIOError):
            client, _ = self._listener.accept()
            pair = self._loop.create_task(self._connect(client))
            self._pairs.add(pair)
            pair.add_done_callback(self._pairs.discard)

    async def _connect(self, client: socket.socket) -> None:
        with closing(client), closing(_socket()) as server:
            client.setblocking(False)
            try:
                if not self._resets:
                    await self._loop.sock_connect(server, ("127.0.0.1", self._server))
                    async with asyncio.TaskGroup() as both:
                        both.create_task(self._forward(client, server, self._count_up))
                        both.create_task(self._forward(server, client, self._count_down))
            except* OSError:
                pass
            finally:
                if self._resets:
                    for one in (client, server):
                        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)

    def _count_up(self, size: int) -> None:
        self.up += size

    def _count_down(self, size: int) -> None:
        self.down += size

    async def _forward(self, source: socket.socket, sink: socket.socket, note: Callable[[int], None]) -> None:
        under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(1000)
        async with asyncio.TaskGroup() as both:
            both.create_task(self._deliver(under_way, sink))
            data = b"more"
            while data:
                size = max(1000, min(_CHUNK, int(self.rate / 100))) if self.rate else _CHUNK
                data = await self._loop.sock_recv(source, size)
                note(len(data))
                await self._through.wait()
                if self.rate:
                    await asyncio.sleep(len(data) / self.rate)
                await under_way.put((self._loop.time() + self.delay, data))

    async def _deliver(self, under_way: asyncio.Queue[tuple[float, bytes]], sink: socket.socket) -> None:
        data = b"more"
        while data:
            due, data = await under_way.get()
            if due > self._loop.time():
                await asyncio.sleep(due - self._loop.time())
            await self._through.wait()
            if data:
                await self._loop.sock_sendall(sink, data)
        sink.shutdown(socket.SHUT_WR)


def _socket() -> socket.socket:
    one = socket.socket()
    one.setblocking(False)
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _CHUNK)  # so that a sender feels a low rate
    return one
