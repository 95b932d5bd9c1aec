"""Servers as tests of live sources need them, on free ports: an MQTT broker, a server of asyncio in a thread, and a
network that can be cut.
"""

from __future__ import annotations

import asyncio
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path

import pytest

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for_port(port: int, is_running: Callable[[], bool]) -> None:
    """Wait, for as long as the server is running, until it listens: a busy machine may take its time."""
    while is_running():
        try:
            socket.create_connection(("127.0.0.1", port), 0.2).close()
            return
        except OSError:
            time.sleep(0.02)
    raise RuntimeError(f"the server for port {port} has ended")


class Broker:
    """Mosquitto with sessions kept over a restart, as its service has them."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
            f"persistence_location {folder}/\nmax_queued_messages 0\nuser root\n"
        )
        self.start()

    def start(self) -> None:
        assert MOSQUITTO is not None
        self._process = subprocess.Popen([MOSQUITTO, "-c", str(self._config)], stderr=subprocess.DEVNULL)
        wait_for_port(self.port, lambda: self._process.poll() is None)

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(10.0)


@contextmanager
def broker(folder: Path) -> Iterator[Broker]:
    """A broker during the block; the test is skipped without mosquitto."""
    if MOSQUITTO is None:
        pytest.skip("needs the MQTT broker mosquitto")
    running = Broker(folder)
    try:
        yield running
    finally:
        running.stop()


class ThreadedServer:
    """A server of asyncio on a free port, in a thread of its own. A subclass writes `serve`."""

    def __init__(self) -> None:
        self.port = free_port()
        self.start()

    def start(self) -> None:
        """Start the server, again after `close`, on its port."""
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self._thread.start()
        while not self._ready.wait(0.1):
            assert self._thread.is_alive()
        wait_for_port(self.port, self._thread.is_alive)

    async def serve(self) -> AsyncIterator[None]:
        """Start the server, yield once it runs, and stop it."""
        raise NotImplementedError
        yield

    async def _run(self) -> None:
        self.loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        async with asynccontextmanager(self.serve)():
            self._ready.set()
            await self._stop.wait()

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()


class Proxy:
    """A forwarder of TCP connections that can be cut and mended, as a network can."""

    def __init__(self, target: int) -> None:
        self.port, self._target = free_port(), target
        self._open: list[socket.socket] = []
        self.mend()

    def mend(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", self.port), reuse_port=False)
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def cut(self) -> None:
        """Close the door and all connections."""
        _close(self._listener)
        for end in self._open:
            _close(end)
        self._open.clear()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                near, _ = listener.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                self._open += [near, far]
                for a, b in ((near, far), (far, near)):
                    threading.Thread(target=_forward, args=(a, b), daemon=True).start()


def _forward(source: socket.socket, target: socket.socket) -> None:
    with suppress(OSError):
        while data := source.recv(65536):
            target.sendall(data)
    for end in (source, target):
        _close(end)


def _close(end: socket.socket) -> None:
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()
