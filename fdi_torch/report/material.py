"""Content of a log, read once for all sections of the page. The file is untrusted input."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import orjson

from fdi_torch.clock import clock_shown, of_stamp
from fdi_torch.effects import units_for_display
from fdi_torch.gap.verdict_words import FORMAT_1
from fdi_torch.logbook import Inspection, LogError, Run, Signals, arrays, inspect_log, own_signals, series
from fdi_torch.logbook.signals import recording_groups
from fdi_torch.logbook.topic_definitions import TOPICS
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import displayed_in

CLOCK = "/source/clock"
# Signals and search populations are read as arrays when needed; messages on all other topics are kept.
SIGNALS = {"/plant/input", "/plant/output", "/estimate/output", "/estimate/residual", "/observer/residual"}
EVENTS = TOPICS.keys() - SIGNALS - {"/estimator/de/population"}
MOST_EVENTS = 100_000

Payload = dict[str, Any]


@dataclass
class Material:
    """Content of one log. events: topic -> messages in order. units: topic -> field -> SI unit. counts: messages of
    every topic. plant: from the log's configuration, None if it has none. problems: what could not be read.
    """

    run: Run
    plant: PlantDescription | None = None
    events: dict[str, list[Payload]] = field(default_factory=dict)
    units: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def about(self, record: str) -> dict[str, str]:
        """A metadata record of ours, such as "status"."""
        return self.run.about(record)

    def listed(self, name: str) -> list[Any]:
        """A list in the run's result; empty if it is missing or unreadable."""
        try:
            value = orjson.loads(self.about("result").get(name, "[]"))
        except ValueError:
            return []
        return value if isinstance(value, list) else []

    @property
    def limits(self) -> dict[str, Mapping[str, Any]]:
        """The ranges of the parameters and the ends at which estimates lie, as `estimate_table` takes them."""
        return {"ends": self.run.at_bounds, "ranges": self.run.ranges}

    @property
    def unexplained(self) -> bool:
        """True if the log says that the model of this run fails to explain its recording."""
        return self.about("result").get("explained") == "false"

    @property
    def kind(self) -> str:
        return self.about("run").get("kind", "")

    @property
    def status(self) -> str:
        """How the run ended, such as 'not converged'; empty without an end."""
        return self.about("status").get("status", "").replace("_", " ")

    @property
    def started(self) -> str:
        """Date and time of the start, UTC; empty if unknown."""
        return self.about("run").get("started", "")[:19].replace("T", " ")

    def of(self, topic: str) -> list[Payload]:
        return self.events.get(topic, [])

    def channel_words(self, channel: str) -> str:
        """The name of a channel's component, with the channel where it differs; the channel if the plant is unknown."""
        return channel if self.plant is None else self.plant.channel_words(channel)

    def unit(self, topic: str, name: str) -> str:
        return self.units.get(topic, {}).get(name, "")

    @cached_property
    def inspection(self) -> Inspection:
        return inspect_log(self.run.path)

    @cached_property
    def groups(self) -> list[str]:
        """Names of the recordings in the log; "" if there is only one."""
        return recording_groups(self.counts)

    @cached_property
    def recordings(self) -> list[Signals]:
        return [own_signals(self.run, group) for group in self.groups]

    @property
    def fitted(self) -> dict[int, Signals]:
        """The recordings that the run was fitted to or watched, by their number from 0: all but the hold-outs."""
        return {k: self.recordings[k] for k, group in enumerate(self.groups) if not group.startswith("holdout")}

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """The run's result arrays; empty if they are missing or unreadable."""
        if "results.npz" not in self.run.attachments:
            return {}
        try:
            return arrays(self.run)
        except LogError as error:
            self.problems.append(str(error))
            return {}

    @cached_property
    def residuals(self) -> dict[str, np.ndarray]:
        """Columns of the observer's residual over time; empty without an observer."""
        return series(self.run, "/observer/residual") if self.counts.get("/observer/residual") else {}

    @cached_property
    def truth(self) -> dict[str, float]:
        """Simulated values by parameter, SI."""
        first = next(iter(self.of("/plant/truth")), {})
        return {name: float(value) for name, value in first.items() if name != "t" and isinstance(value, int | float)}

    @cached_property
    def answer(self) -> Payload:
        """The answer of a gap diagnosis; empty if there is none."""
        text = next((message.get("answer", "") for message in reversed(self.of("/gap/verdict"))), "")
        if not text:
            return {}
        try:
            answer = orjson.loads(text)
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            self.problems.append("/gap/verdict: the answer is not a JSON object")
            return {}
        return answer

    @property
    def where(self) -> dict[str, Payload]:
        """The `share` of each location of a gap diagnosis, see `meaning_of_shares`."""
        return {str(place["location"]): place for place in (*self.of("/gap/where"), *self.answer.get("where", []))}

    @contextmanager
    def in_its_units(self) -> Iterator[None]:
        """Context of display: the units of the run's plant and of its recordings, and the recordings' clock."""
        written = (key.partition(".unit.") for key in self.about("data"))
        channels = {name: self.about("data")[f"{k}.unit.{name}"] for k, divided, name in written if divided}
        units = {**(units_for_display(self.plant) if self.plant else {}), **channels}
        with clock_shown(self.clock_zeros, self._first_times), displayed_in(units):
            yield

    @property
    def clock_zeros(self) -> list[float | None]:
        """Date and time of time 0 of each recording by its clock, s since 1970; None for a clock without dates."""
        about = self.about("data")
        numbers = [key.removesuffix(".path") for key in about if key.endswith(".path")]
        zeros = [_clock_zero(about.get(f"{k}.began")) for k in numbers]
        origins = [message.get("origin") for message in self.of(CLOCK)]
        return zeros or [float(zero) for zero in origins if isinstance(zero, int | float)]

    @property
    def _first_times(self) -> list[float]:
        """Time of the first sample of each recording, s."""
        about = self.about("data")
        numbers = [key.removesuffix(".path") for key in about if key.endswith(".path")]
        return [_seconds(about.get(f"{k}.first", "0")) for k in numbers] or [0.0]

    @property
    def meaning_of_shares(self) -> str:
        """Meaning of the number at each location of a gap diagnosis, which differs in format 1."""
        if self.answer.get("format") == FORMAT_1:
            return "share of the gap that a free discrepancy there alone closes"
        return "probability that something is wrong there"


def _clock_zero(began: str | None) -> float | None:
    """Begin of a recording in its own time zone, s since 1970; None if it has no date."""
    try:
        return None if began is None else sum(of_stamp(began))
    except ValueError:
        return None


def _seconds(text: str) -> float:
    """A time of a log; 0 for anything else."""
    try:
        return float(text)
    except ValueError:
        return 0.0


def gather(run: Run, plant: PlantDescription | None = None) -> Material:
    """Read a log, ideally opened with `salvage`, so that the intact part of a damaged log is shown."""
    material = Material(run, plant)
    for message in run.messages():
        topic = message.topic
        if topic not in material.counts:
            material.units[topic] = message.channel.units
        material.counts[topic] = material.counts.get(topic, 0) + 1
        if topic not in EVENTS or material.counts[topic] > MOST_EVENTS:
            continue
        try:
            material.events.setdefault(topic, []).append(message.payload)
        except LogError as error:
            material.problems.append(str(error))
    return material
