"""Events of a monitor as messages of its log."""

from __future__ import annotations

from typing import Any

import orjson

from fdi_torch.monitor.events import FORMAT, Event


def event_key(payload: dict[str, Any]) -> tuple[Any, ...]:
    """Key by which a logged event is recognised in another log."""
    return payload["t"], payload["event"], payload["message"]


def event_fields(event: Event) -> dict[str, Any]:
    """An event's fields for the log: numbers, texts and flat lists, and the whole event as JSON in `details`."""
    fields: dict[str, Any] = {
        "alarm": event.alarm or None,
        "state": str(event.state),
        "headline": event.headline if event.explanations else None,
        "faults": list(event.faults) or None,
        "sizes": list(event.sizes) or None,
        "stds": list(event.stds) or None,
        "units": list(event.units) or None,
        "onset": event.onset,
        "onset_std": event.onset_std,
        "delay": event.delay,
        "growing": event.growing if event.faults else None,
        "explanations": [e.text for e in event.explanations] or None,
        "masses": [e.mass for e in event.explanations] or None,
        "sensors": [name for name, _ in event.shares] or None,
        "shares": [share for _, share in event.shares] or None,
        "first": event.first,
        "last": event.last,
        "count": event.count,
        "severity": event.severity or None,
        "announced": event.announced,
        "format": FORMAT,
        "details": orjson.dumps(event.to_dict()).decode(),
    }
    return fields
