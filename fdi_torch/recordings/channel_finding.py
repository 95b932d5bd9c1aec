"""A finding of a check of a recording: a sentence, and the numbers behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ChannelFinding:
    """kind: read, clock, gap, constant, constant input, clipped, frozen, quantised, range, rim, unit, missing, on
    change, undersampled, unknown, stuck or slip. values: the numbers stated in `text`, by name, SI.
    """

    kind: str
    channel: str
    text: str
    values: Mapping[str, float] = field(default_factory=dict)
