"""What a live source delivers: values of tags, and the interface of the connections that deliver them; its URL, and the
credentials for it.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import unquote, urlsplit

PORTS: Mapping[str, int] = {"mqtt": 1883, "mqtts": 8883, "opcua": 4840, "modbus": 502}
"""Registered port of each scheme."""
USER, PASSWORD = "FDI_TORCH_USER", "FDI_TORCH_PASSWORD"
"""Environment variables with the credentials, which must not reach a log."""


@dataclass(frozen=True)
class Address:
    """scheme: as in PORTS. path: what follows host and port, without its first slash."""

    scheme: str
    host: str
    port: int
    path: str

    @property
    def place(self) -> str:
        """Host and port as text."""
        return f"{self.host}:{self.port}"


def address_of(url: str, schemes: tuple[str, ...] = tuple(PORTS)) -> Address:
    """The parts of a URL. Raises ValueError for another scheme, a missing host, and a password."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise ValueError(f"expected a URL such as mqtt://localhost:1883/rig, got '{url}' ({error})") from None
    if parts.scheme not in schemes or not parts.hostname:
        wanted = ", ".join(f"{scheme}://HOST" for scheme in schemes)
        raise ValueError(f"expected a URL of the kind {wanted}, got '{url}'")
    if parts.username is not None or parts.password is not None:
        raise ValueError(
            f"expected a URL without user and password, which would be kept in the log; "
            f"set the environment variables {USER} and {PASSWORD}"
        )
    path = unquote(parts.path.removeprefix("/"))
    return Address(parts.scheme, parts.hostname, port or PORTS[parts.scheme], path)


def credentials() -> tuple[str, str] | None:
    """User and password from the environment; None without a user."""
    user = os.environ.get(USER)
    return None if user is None else (user, os.environ.get(PASSWORD, ""))


MOST_WAITING = 200_000
"""Values that wait for the monitor, beyond which the oldest are dropped."""


@dataclass(frozen=True)
class Value:
    """A measured value. stamp: its time, s, by the clock of the source. number: NaN for a bad reading."""

    tag: str
    stamp: float
    number: float


Item = Value | str
"""A value, or a sentence about the connection for the log."""


class Connection(Protocol):
    """A connection to a live source, which is renewed after each loss.

    dated: whether stamps are seconds since 1970; otherwise they are plant time as it is.
    """

    dated: bool

    def read(self, timeout: float) -> list[Item]:
        """Everything that has arrived since the last call; waits up to `timeout` s for the first item.

        Raises ValueError if the source refuses the connection for good.
        """
        ...

    def close(self) -> None: ...


class Inbox:
    """Buffer between a network thread and the monitor. Of more than MOST_WAITING items, the oldest are dropped."""

    def __init__(self) -> None:
        self._items: deque[Item] = deque(maxlen=MOST_WAITING)
        self._arrived = threading.Condition()
        self._dropped = 0

    def put(self, items: Iterable[Item]) -> None:
        added = list(items)
        with self._arrived:
            before = len(self._items)
            self._items.extend(added)
            self._dropped += before + len(added) - len(self._items)
            self._arrived.notify()

    def take(self, timeout: float) -> list[Item]:
        """All items; waits up to `timeout` s for the first."""
        with self._arrived:
            if not self._items:
                self._arrived.wait(timeout)
            items = list(self._items)
            self._items.clear()
            if self._dropped:
                items.insert(0, f"{self._dropped} values came faster than the monitor processes them and were dropped")
                self._dropped = 0
        return items
