"""OPC UA: subscription to the nodes of a rig. Only this file imports asyncua (extra `opcua`)."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC
from typing import Any

from fdi_torch.live.values import Address, Inbox, Item, Value, credentials
from fdi_torch.tables import needed

WAIT = 15.0
"""Time within which a server must accept the first connection, s."""
ALIVE = 1.0
"""Interval at which the server's state is read, and time within which it must answer, s."""
SILENT = 5.0
"""Time without a value on a renewed connection after which the nodes are subscribed to anew, s."""
LONGEST_RETRY = 30.0
"""Longest waiting time between attempts to connect, s; the first is 1 s, doubled after each."""
QUEUE = 1000
"""Values of a node that the server keeps between two publications."""


class OpcUaSource:
    """Values of nodes, with their source times, as a Connection.

    tags: node identifiers such as ns=2;s=Rig.h1. period: sampling interval of
    the server; publish: interval of its notifications, s. The server is asked for a
    notification of each new time, so that a constant value is delivered as well.
    """

    dated = True

    def __init__(self, address: Address, tags: Sequence[str], period: float, publish: float) -> None:
        self._asyncua = needed("asyncua", "opcua")
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # losses are reported as events
        self._url = f"opc.tcp://{address.place}/{address.path}".rstrip("/")
        self._place, self._tags, self._period, self._publish = address.place, tags, period, publish
        self._lost_at: float | None = None
        self._silent_since = time.monotonic()  # on a renewed connection
        self._subscription: Any = None
        self._waiting: list[Value] | None = []  # values before each node has sent its first; None from then on
        self._inbox, self._stop, self._connected = Inbox(), threading.Event(), threading.Event()
        self._refusal: Exception | None = None
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True, name="opcua")
        self._thread.start()
        if not self._connected.wait(WAIT) or self._refusal is not None:
            self._stop.set()
            reason = str(self._refusal) or type(self._refusal).__name__ if self._refusal else f"nothing for {WAIT:g} s"
            raise ValueError(f"expected an OPC UA server with these nodes at {self._place}, got: {reason}")

    def read(self, timeout: float) -> list[Item]:
        return self._inbox.take(timeout)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(WAIT)

    def datachange_notification(self, node: Any, number: Any, data: Any) -> None:
        """Called by asyncua for each notification."""
        if self._lost_at is not None:
            self._inbox.put([f"connected to {self._place} again after {time.monotonic() - self._lost_at:.1f} s"])
            self._lost_at = None
        value = data.monitored_item.Value
        stamp = value.SourceTimestamp or value.ServerTimestamp
        if stamp is not None and stamp.tzinfo is None:  # some versions of asyncua leave UTC out
            stamp = stamp.replace(tzinfo=UTC)
        at = time.time() if stamp is None else stamp.timestamp()
        is_number = value.StatusCode.is_good() and isinstance(number, bool | int | float)
        self._deliver(Value(self._names[node.nodeid], at, float(number) if is_number else math.nan))

    def _deliver(self, value: Value) -> None:
        """Put a value into the inbox. The server first sends the present value of each node, which has the time of its
        last change, perhaps hours ago; all of these hold from the latest of their times on.
        """
        if self._waiting is None:
            self._inbox.put([value])
            return
        self._waiting.append(value)
        present = {each.tag: each.stamp for each in reversed(self._waiting)}
        if len(present) == len(set(self._tags)):
            latest = max(present.values())
            self._inbox.put([replace(each, stamp=max(each.stamp, latest)) for each in self._waiting])
            self._waiting = None

    def status_change_notification(self, status: Any) -> None:
        """Called by asyncua when the server ends the subscription; the connection check handles it."""

    async def _run(self) -> None:
        """Deliver notifications until `close`. The library renews a lost connection, and the session if it can."""
        try:
            client = self._asyncua.Client(
                self._url, watchdog_intervall=ALIVE, auto_reconnect=True, reconnect_max_delay=LONGEST_RETRY
            )
            client.connection_lost_callback = self._lost
            if (known := credentials()) is not None:
                client.set_user(known[0])
                client.set_password(known[1])
            await client.connect()
        except Exception as error:  # asyncua has no base class for what a first connection raises
            self._refuse(error)
            return
        try:
            await self._subscribe(client)
            self._connected.set()
            while not self._stop.is_set():  # a waiting thread of the pool would outlive Ctrl-C
                await asyncio.sleep(0.1)
                await self._ensure_subscribed(client)
        except Exception as error:
            self._refuse(error)
        finally:
            # A server that is gone cannot answer; the process ends all the same.
            with suppress(Exception):
                await asyncio.wait_for(client.disconnect(), 2.0 * ALIVE)

    async def _ensure_subscribed(self, client: Any) -> None:
        """Subscribe anew if no value has come for a while on a renewed connection. The library restores a subscription
        once: if the restarted server answers too late, it would remain without nodes."""
        lost_at, now = self._lost_at, time.monotonic()
        if lost_at is None or client.uaclient.state.name != "CONNECTED":
            self._silent_since = now
        elif now - self._silent_since > SILENT:
            self._silent_since = now
            with suppress(Exception):  # before the new one, which may get the same number from a restarted server
                await asyncio.wait_for(self._subscription.delete(), SILENT)
            self._lost_at = lost_at  # a value that came meanwhile was the last of the old subscription
            with suppress(Exception):
                await asyncio.wait_for(self._subscribe(client), SILENT)

    async def _subscribe(self, client: Any) -> None:
        """Raises a status code of the server for a node that does not exist."""
        ua = self._asyncua.ua
        nodes = [client.get_node(tag) for tag in self._tags]
        self._names = {node.nodeid: tag for node, tag in zip(nodes, self._tags, strict=True)}
        for node, tag in zip(nodes, self._tags, strict=True):
            try:
                await node.read_data_value()
            except ua.UaError as error:
                raise ValueError(f"{tag}: {_text(error)}") from None
        self._subscription = await client.create_subscription(1000.0 * self._publish, self)
        every_time = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
        monitored = []
        for k, node in enumerate(nodes):
            item = ua.MonitoredItemCreateRequest(ItemToMonitor=ua.ReadValueId(node.nodeid, ua.AttributeIds.Value))
            item.MonitoringMode = ua.MonitoringMode.Reporting
            item.RequestedParameters = ua.MonitoringParameters(k + 1, 1000.0 * self._period, every_time, QUEUE, True)
            monitored.append(item)
        for result in await self._subscription.create_monitored_items(monitored):
            if isinstance(result, ua.StatusCode):
                result.check()

    def _refuse(self, error: Exception) -> None:
        self._refusal = error
        self._connected.set()

    async def _lost(self, error: Exception) -> None:
        self._lost_at = time.monotonic()
        self._inbox.put([f"connection to {self._place} lost ({_text(error)}); trying again"])


def _text(error: Exception) -> str:
    return str(error) or type(error).__name__
