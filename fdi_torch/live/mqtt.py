"""MQTT: subscription to the topics of a rig, and publication of events. Only this file imports paho (extra `mqtt`)."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import orjson

from fdi_torch.live.values import Address, Inbox, Item, Value, credentials
from fdi_torch.logbook import number_at
from fdi_torch.recordings.time_stamps import seconds_of
from fdi_torch.tables import needed

WAIT = 10.0
"""Time within which a broker must answer the first connection, s."""
KEEPALIVE = 15
"""Interval of the sign of life, s, after one and a half of which a broken connection is noticed."""
FIRST_RETRY, LONGEST_RETRY = 1, 30
"""Waiting times between attempts to connect, s; doubled after each."""


class MqttClient:
    """A connection to a broker that is renewed after a loss, subscribed to `topics` with quality of service 1.

    session: name under which the broker keeps messages while the connection is lost; none if empty. on_message: called
    with topic and payload. on_state: called with a sentence for each change of the connection. Raises ValueError if the
    broker cannot be reached or refuses the first connection.
    """

    def __init__(
        self,
        address: Address,
        topics: Sequence[str] = (),
        session: str = "",
        on_message: Callable[[str, bytes], None] | None = None,
        on_state: Callable[[str], None] | None = None,
    ) -> None:
        paho = needed("paho.mqtt.client", "mqtt")
        self._topics, self._place = topics, address.place
        self._on_message, self._on_state = on_message, on_state
        self._answered, self._refusal = threading.Event(), ""
        self._lost_at: float | None = None
        self._last: Any = None  # the message that was published last
        self._client = paho.Client(
            paho.CallbackAPIVersion.VERSION2, client_id=session, clean_session=not session, protocol=paho.MQTTv311
        )
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_message = self._received
        self._client.reconnect_delay_set(FIRST_RETRY, LONGEST_RETRY)
        if address.scheme == "mqtts":
            self._client.tls_set()
        if (known := credentials()) is not None:
            self._client.username_pw_set(*known)
        self._connect(address)

    def publish(self, topic: str, payload: bytes, retain: bool = False) -> None:
        """Send a message, or keep it until the connection is renewed."""
        self._last = self._client.publish(topic, payload, qos=1, retain=retain)

    def close(self, wait: float = 0.0) -> None:
        """Disconnect, after waiting up to `wait` s for the last message to be confirmed."""
        if self._last is not None and self._client.is_connected():
            self._last.wait_for_publish(wait)
        self._client.disconnect()
        self._client.loop_stop()

    def _connect(self, address: Address) -> None:
        try:
            self._client.connect(address.host, address.port, keepalive=KEEPALIVE)
        except OSError as error:
            raise ValueError(f"expected an MQTT broker at {self._place}, got none ({error}); start it") from None
        self._client.loop_start()
        if self._answered.wait(WAIT) and not self._refusal:
            return
        self._client.loop_stop()
        reason = self._refusal or f"no answer within {WAIT:g} s"
        raise ValueError(f"expected the MQTT broker at {self._place} to accept the connection, got: {reason}")

    def _connected(self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._refusal = str(reason)
            self._answered.set()
            return
        if self._topics:
            client.subscribe([(topic, 1) for topic in self._topics])
        if self._lost_at is not None and self._on_state is not None:
            self._on_state(f"connected to {self._place} again after {time.monotonic() - self._lost_at:.1f} s")
        self._lost_at = None
        self._answered.set()

    def _disconnected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if self._lost_at is None and reason.is_failure:
            self._lost_at = time.monotonic()
            if self._on_state is not None:
                self._on_state(f"connection to {self._place} lost ({reason}); trying again")

    def _received(self, _client: Any, _data: Any, message: Any) -> None:
        if self._on_message is not None:
            self._on_message(message.topic, message.payload)


class MqttSource:
    """Values of tags 'TOPIC' (the payload is a number) or 'TOPIC:FIELD' (a field of a JSON object), as a Connection.

    clock: field of the same JSON object with the time; None: the time of arrival. second: unit of these numbers, s;
    None if they are ISO 8601 stamps. dated: whether numbers count from 1970.
    """

    def __init__(
        self,
        address: Address,
        tags: Sequence[str],
        clock: str | None = None,
        second: float | None = None,
        dated: bool = False,
        session: str = "",
    ) -> None:
        self.dated = dated or clock is None or second is None
        self._clock, self._second = clock, second
        self._fields: dict[str, list[tuple[str, str]]] = {}
        for tag in tags:
            topic, _, field = tag.rpartition(":")
            self._fields.setdefault(topic or tag, []).append((tag, field if topic else ""))
        self._inbox, self._unreadable = Inbox(), 0
        self._client = MqttClient(address, list(self._fields), session, self._receive, lambda s: self._inbox.put([s]))

    def read(self, timeout: float) -> list[Item]:
        return self._inbox.take(timeout)

    def close(self) -> None:
        self._client.close()

    def _receive(self, topic: str, payload: bytes) -> None:
        try:
            self._inbox.put(self._values(topic, payload))
        except ValueError as error:
            # Said once for one, two, four ... messages, because a wrong topic brings one a second.
            self._unreadable += 1
            if self._unreadable & (self._unreadable - 1) == 0:
                self._inbox.put([f"{topic}: {error}; the message is left out ({self._unreadable} so far)"])

    def _values(self, topic: str, payload: bytes) -> list[Item]:
        """Raises ValueError for a payload that cannot be read."""
        fields = self._fields.get(topic, [])
        data = _parsed(payload)
        is_object = isinstance(data, Mapping)
        if not is_object and any(field for _, field in fields):
            raise ValueError(f"expected a JSON object, got '{payload[:40].decode(errors='replace')}'")
        stamp = self._stamp(data if is_object else {})
        numbers = [number_at(data, field) if field else _number(data) for _, field in fields]
        return [Value(tag, stamp, number) for (tag, _), number in zip(fields, numbers, strict=True)]

    def _stamp(self, data: Mapping[str, Any]) -> float:
        if self._clock is None:
            return time.time()
        if self._second is None:
            stamp = seconds_of(str(data.get(self._clock, "")))
        else:
            stamp = number_at(data, self._clock) * self._second
        if not math.isfinite(stamp):
            raise ValueError(f"expected the time in the field '{self._clock}', got none")
        return stamp


def _parsed(payload: bytes) -> Any:
    try:
        return orjson.loads(payload)
    except orjson.JSONDecodeError:
        raise ValueError(f"expected JSON or a number, got '{payload[:40].decode(errors='replace')}'") from None


def _number(data: Any) -> float:
    """A payload that is a number; NaN for null."""
    if data is None:
        return math.nan
    if isinstance(data, bool | int | float):
        return float(data)
    raise ValueError("expected a number, got a JSON object; name the field, as in tag: 'rig/level:value'")


class EventPublisher:
    """Publisher of events below the topic of `address` (by default fdi): TOPIC/event, and the retained TOPIC/state.

    Events that happen while the connection is lost are sent after its renewal.
    """

    def __init__(self, address: Address) -> None:
        self._topic = address.path.rstrip("/") or "fdi"
        self._client = MqttClient(address)

    def __enter__(self) -> EventPublisher:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close(wait=WAIT)

    def publish(self, event: Mapping[str, Any]) -> None:
        """Publish an event as in the output of --json; its state and faults become the retained message."""
        state = {key: event.get(key) for key in ("time", "state", "faults", "headline")}
        self._client.publish(f"{self._topic}/event", orjson.dumps(event))
        self._client.publish(f"{self._topic}/state", orjson.dumps(state), retain=True)
