"""Prometheus metrics of a running monitor. Only this file imports prometheus_client (extra `prometheus`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from fdi_torch.logbook.payload import decode
from fdi_torch.logbook.topic_definitions import Channel
from fdi_torch.tables import needed

TOPICS = ("/plant/input", "/plant/output", "/observer/residual", "/observer/alarm", "/diagnosis/fault")


class Metrics:
    """Listener that turns logged messages into metrics. Created by `serve_metrics`. Numbers are SI.

    kinds: of events, whose counters begin at 0, so that a rate of Prometheus sees the first event.
    """

    def __init__(self, library: Any, kinds: Iterable[str] = ()) -> None:
        self.registry = library.CollectorRegistry()
        self.port = 0

        def gauge(name: str, meaning: str, *labels: str) -> Any:
            return library.Gauge(f"fdi_{name}", meaning, labels, registry=self.registry)

        def counter(name: str, meaning: str, *labels: str) -> Any:
            return library.Counter(f"fdi_{name}", meaning, labels, registry=self.registry)

        self._samples = counter("samples", "samples processed")
        self._events = counter("events", "events of the monitor", "kind")
        for kind in kinds:
            self._events.labels(kind)
        self._time = gauge("plant_time_seconds", "time of the last sample; NaN before the first")
        self._time.set(float("nan"))  # a gauge without labels begins at 0, which would be a time
        self._inputs = gauge("input", "inputs of the plant, SI", "channel")
        self._readings = gauge("reading", "readings of the sensors, SI", "channel")
        self._residuals = gauge("residual", "reading less output of the observer, SI", "channel")
        self._detector = gauge("detector", "statistic of the detector and its threshold", "quantity")
        self._present = gauge("fault_present", "1 while the monitor attributes the readings to this fault", "fault")
        self._probability = gauge("fault_probability", "probability that this parameter has changed", "fault")
        self._size = gauge("fault_size", "estimated parameter, SI", "fault")

    def __call__(self, channel: Channel, log_time: int, data: bytes) -> None:
        if channel.topic not in TOPICS:
            return
        payload = decode(data)
        match channel.topic:
            case "/plant/input":
                _set_all(self._inputs, payload)
            case "/plant/output":
                self._samples.inc()
                self._time.set(payload["t"])
                _set_all(self._readings, payload)
            case "/observer/residual":
                tests = [name for name in payload if name.endswith(("_statistic", "_threshold"))]
                for name in tests:
                    self._detector.labels(name.rpartition("_")[2]).set(payload.pop(name))
                _set_all(self._residuals, payload)
            case "/observer/alarm":
                self._events.labels(payload["event"]).inc()
            case "/diagnosis/fault":
                name = f"{payload['location']}.{payload['fault']}"
                self._present.labels(name).set(bool(payload["present"]))
                for gauge, key in ((self._probability, "probability"), (self._size, "size")):
                    if payload.get(key) is not None:
                        gauge.labels(name).set(payload[key])


def _set_all(gauge: Any, payload: dict[str, Any]) -> None:
    """Set a gauge for each named number, which is NaN for a missing reading."""
    for name, value in payload.items():
        if name != "t" and isinstance(value, int | float):
            gauge.labels(name).set(value)


@contextmanager
def serve_metrics(host: str, port: int, kinds: Iterable[str]) -> Iterator[Metrics]:
    """A server of /metrics during the block. port 0: any free port. kinds: as of `Metrics`.

    Raises ValueError for an address in use.
    """
    library = needed("prometheus_client", "prometheus")
    metrics = Metrics(library, kinds)
    try:
        server, thread = library.start_http_server(port, host, metrics.registry)
    except OSError as error:
        raise ValueError(
            f"--metrics: expected a free address, got {host}:{port} ({error}); name another port"
        ) from None
    metrics.port = server.server_port
    try:
        yield metrics
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
