"""The URL of a live source or of a broker, and the credentials for it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
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
