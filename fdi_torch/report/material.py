"""What a log holds, read once for all sections of the page. The file is untrusted input."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import orjson

from fdi_torch.gap.verdict_words import FORMAT_1
from fdi_torch.logbook import Inspection, LogError, Run, Signals, arrays, inspect_log, own_signals, series
from fdi_torch.plant.description import PlantDescription

# Signals and the search's populations are read as arrays, or not at all.
EVENTS = (
    "/plant/truth",
    "/observer/alarm",
    "/estimator/de/generation",
    "/estimator/refine/iteration",
    "/estimate/final",
    "/diagnosis/fault",
    "/gap/where",
    "/gap/verdict",
    "/study/trial",
    "/study/summary",
    "/log",
)
MOST_EVENTS = 100_000

Payload = dict[str, Any]


@dataclass
class Material:
    """One run. events: topic -> messages in order. units: topic -> field -> SI unit. counts: messages of every topic.

    plant: as the log's configuration describes it, None where it does not. trouble: what could not be read, in words.
    """

    run: Run
    plant: PlantDescription | None = None
    events: dict[str, list[Payload]] = field(default_factory=dict)
    units: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    trouble: list[str] = field(default_factory=list)

    def about(self, record: str) -> dict[str, str]:
        """A metadata record of ours, such as "status"."""
        return self.run.metadata.get(f"fdi_torch.{record}", {})

    def listed(self, name: str) -> list[Any]:
        """A list of the run's result; empty where there is none, or none that can be read."""
        try:
            found = orjson.loads(self.about("result").get(name, "[]"))
        except ValueError:
            return []
        return found if isinstance(found, list) else []

    @property
    def kind(self) -> str:
        return self.about("run").get("kind", "")

    def of(self, topic: str) -> list[Payload]:
        return self.events.get(topic, [])

    def unit(self, topic: str, name: str) -> str:
        return self.units.get(topic, {}).get(name, "")

    @cached_property
    def inspection(self) -> Inspection:
        return inspect_log(self.run.path)

    @cached_property
    def groups(self) -> list[str]:
        """Names of the recordings in the log; "" where there is one."""
        found = [topic.split("/") for topic in self.counts if topic.startswith("/plant/") and topic.endswith("/output")]
        return ["/".join(parts[2:-1]) for parts in found]

    @cached_property
    def recordings(self) -> list[Signals]:
        return [own_signals(self.run, group) for group in self.groups]

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """The run's result arrays; none where there are none, or none that can be read."""
        if "results.npz" not in self.run.attachments:
            return {}
        try:
            return arrays(self.run)
        except LogError as error:
            self.trouble.append(str(error))
            return {}

    @cached_property
    def residuals(self) -> dict[str, np.ndarray]:
        """Columns of the observer's residual over time; none where nothing observed."""
        return series(self.run, "/observer/residual") if self.counts.get("/observer/residual") else {}

    @cached_property
    def truth(self) -> dict[str, float]:
        """What was simulated, by parameter: the first message of the truth, SI."""
        first = next(iter(self.of("/plant/truth")), {})
        return {name: float(value) for name, value in first.items() if name != "t" and isinstance(value, int | float)}

    @cached_property
    def answer(self) -> Payload:
        """The answer of a gap diagnosis; empty where there is none."""
        text = next((message.get("answer", "") for message in reversed(self.of("/gap/verdict"))), "")
        if not text:
            return {}
        try:
            found = orjson.loads(text)
        except ValueError:
            found = None
        if not isinstance(found, dict):
            self.trouble.append("/gap/verdict: the answer is no JSON object")
            return {}
        return found

    @property
    def meaning_of_shares(self) -> str:
        """What the number beside each place of a gap diagnosis is; in format 1 of its answer it was another one."""
        if self.answer.get("format") == FORMAT_1:
            return "share of the gap that a free discrepancy there alone closes"
        return "probability that something is wrong there"


def gather(run: Run, plant: PlantDescription | None = None) -> Material:
    """Reads a log, best opened with `salvage`, so that a damaged one shows what is whole."""
    material = Material(run, plant)
    for message in run.messages():
        topic = message.topic
        if topic not in material.counts:
            pairs = message.channel.metadata
            material.units[topic] = {k.removeprefix("unit."): v for k, v in pairs if k.startswith("unit.")}
        material.counts[topic] = material.counts.get(topic, 0) + 1
        if topic not in EVENTS or material.counts[topic] > MOST_EVENTS:
            continue
        try:
            material.events.setdefault(topic, []).append(message.payload)
        except LogError as error:
            material.trouble.append(str(error))
    return material
