"""The topics of a log: the meaning, kind and unit of every field of their messages, all in SI; and the channel of a
topic in an MCAP file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Channel:
    """Encoding, schema and metadata of a topic; metadata are pairs, so that channels can be compared and hashed."""

    topic: str
    encoding: str = "json"
    schema_name: str = ""
    schema_encoding: str = ""
    schema_data: bytes = field(default=b"", hash=False)  # too long to be hashed for each message
    metadata: tuple[tuple[str, str], ...] = field(default=(), hash=False)

    @property
    def units(self) -> dict[str, str]:
        """The SI unit of each field that has one."""
        return {key.removeprefix("unit."): unit for key, unit in self.metadata if key.startswith("unit.")}


FORMAT_VERSION = "1"

Kind = Literal["number", "integer", "boolean", "text", "numbers", "integers", "texts", "time"]


@dataclass(frozen=True)
class Topic:
    """One kind of message. fields: name -> (kind, unit, meaning). named: whether further named numbers are allowed."""

    schema: str
    meaning: str
    fields: Mapping[str, tuple[Kind, str, str]] = field(default_factory=dict)
    named: bool = True


_EVENT: dict[str, tuple[Kind, str, str]] = {"problem": ("integer", "", "which of the batched problems")}

TOPICS: dict[str, Topic] = {
    "/plant/input": Topic("fdi_torch.plant_input", "commands to the plant"),
    "/plant/output": Topic(
        "fdi_torch.plant_output", "readings of the sensors", {"masked": ("texts", "", "readings that are not used")}
    ),
    "/plant/truth": Topic("fdi_torch.plant_truth", "true states and faults of a simulated plant"),
    "/source/clock": Topic(
        "fdi_torch.source_clock",
        "the clock of a live source",
        {"origin": ("number", "s", "time 0 of the plant, since 1970-01-01 UTC")},
        named=False,
    ),
    "/observer/residual": Topic(
        "fdi_torch.residual", "reading less observer's output; *_statistic, *_threshold where tested"
    ),
    "/observer/alarm": Topic(
        "fdi_torch.alarm",
        "an event of the detection",
        {
            "event": ("text", "", "raised, isolated, sized, cleared or recovered"),
            "channel": ("text", "", "sensor or fault it concerns"),
            "value": ("number", "", "test statistic"),
            "threshold": ("number", "", "its threshold"),
            "onset": ("number", "s", "estimated time of the change"),
            "message": ("text", "", "the event in words"),
        },
    ),
    "/estimator/de/generation": Topic(
        "fdi_torch.generation",
        "a generation of differential evolution and its best member",
        {
            **_EVENT,
            "generation": ("integer", "", "0 is the first population"),
            "best_cost": ("number", "", "lowest cost"),
            "mean_cost": ("number", "", "mean of the finite costs"),
            "spread": ("number", "", "spread of the population"),
            "evaluations": ("integer", "", "simulations so far"),
        },
    ),
    "/estimator/de/population": Topic(
        "fdi_torch.population",
        "state of the search: arrays as base64 of little-endian bytes, each with *_shape and *_dtype",
        {**_EVENT, "generation": ("integer", "", "0 is the first population")},
    ),
    "/estimator/refine/iteration": Topic(
        "fdi_torch.refine_iteration",
        "an iteration of the refinement",
        {
            **_EVENT,
            "iteration": ("integer", "", "0 is the start"),
            "cost": ("number", "", "objective"),
            "step": ("number", "", "norm of the scaled step"),
            "gradient": ("number", "", "norm of the scaled gradient"),
            "damping": ("number", "", "Levenberg-Marquardt damping"),
            "accepted": ("boolean", "", "was the step taken?"),
        },
    ),
    "/estimate/final": Topic(
        "fdi_torch.estimate",
        "the estimate and its uncertainty",
        {
            **_EVENT,
            "names": ("texts", "", "parameters, in the order of the arrays"),
            "units": ("texts", "", "their units"),
            "values": ("numbers", "", "estimate"),
            "std": ("numbers", "", "standard errors"),
            "covariance": ("numbers", "", "row by row"),
            "covariance_shape": ("integers", "", "its shape"),
            "status": ("text", "", "converged, or why not"),
            "reason": ("text", "", "status in words"),
            "at_bound": ("texts", "", "parameters at a bound"),
            "unidentifiable": ("texts", "", "directions the data do not determine"),
        },
    ),
    "/estimate/output": Topic("fdi_torch.estimated_output", "readings that the model predicts at the estimate"),
    "/estimate/residual": Topic(
        "fdi_torch.estimate_residual",
        "reading less prediction at the estimate; *_low, *_high: 95 % band of the noise, where its level is known",
    ),
    "/diagnosis/fault": Topic(
        "fdi_torch.fault",
        "a fault found, or found absent",
        {
            "fault": ("text", "", "parameter or effect"),
            "location": ("text", "", "component"),
            "present": ("boolean", "", "at the stated confidence"),
            "confidence": ("number", "1", "that it is present"),
            "size": ("number", "", "in its own unit"),
            "size_std": ("number", "", "standard error"),
            "unit": ("text", "", "unit of the size"),
            "flow": ("number", "m^3/s", "size as flow"),
            "hole_diameter": ("number", "m", "size as equivalent hole"),
            "message": ("text", "", "the finding in words"),
        },
    ),
    "/gap/where": Topic(
        "fdi_torch.gap_where",
        "how likely it is that something is wrong at a component (answers of format 1: share of the gap it can close)",
        {
            "location": ("text", "", "component"),
            "share": ("number", "1", "probability"),
            "p_value": ("number", "1", "of no gap there"),
        },
    ),
    "/gap/verdict": Topic(
        "fdi_torch.gap_verdict",
        "the diagnosis of the sim-to-real gap",
        {
            "verdict": ("text", "", "no_gap, named, ambiguous or unknown"),
            "p_value": ("number", "1", "of no gap"),
            "locations": ("texts", "", "where"),
            "shares": ("numbers", "1", "probability, per location"),
            "causes": ("texts", "", "effect@location"),
            "ambiguity_set": ("texts", "", "explanations that hold 95 % together"),
            "explanations": ("texts", "", "explanations compared"),
            "probabilities": ("numbers", "1", "posterior of each explanation"),
            "unexamined": ("number", "1", "posterior of all explanations that were not examined"),
            "certain": ("texts", "", "effect@location, present with 95 % in all explanations together"),
            "answer": ("text", "", "the whole answer as JSON text"),
        },
    ),
    "/study/trial": Topic(
        "fdi_torch.trial",
        "one trial of a study",
        {
            "trial": ("integer", "", "number"),
            "group": ("text", "", "setting it belongs to"),
            "seed": ("text", "", "its seed"),
            "status": ("text", "", "how it ended"),
        },
    ),
    "/study/summary": Topic(
        "fdi_torch.summary",
        "summary of a setting of a study",
        {"group": ("text", "", "setting"), "trials": ("integer", "", "how many")},
    ),
    "/log": Topic(
        "foxglove.Log",
        "log messages",
        {
            "timestamp": ("time", "", "plant time since 2000-01-01"),
            "level": ("integer", "", "1 debug, 2 info, 3 warning, 4 error, 5 fatal"),
            "message": ("text", "", "one sentence"),
            "name": ("text", "", "sender"),
            "file": ("text", "", "unused"),
            "line": ("integer", "", "unused"),
        },
        named=False,
    ),
}


def topic_definition(topic: str) -> Topic:
    """The definition of a topic; `/plant/GROUP/input` has that of `/plant/input`, and so for `/estimate/GROUP/...`."""
    parts = topic.split("/")
    key = f"/{parts[1]}/{parts[3]}" if len(parts) == 4 and parts[1] in ("plant", "estimate") else topic
    if key not in TOPICS:
        raise ValueError(f"expected one of the topics {', '.join(TOPICS)}, got {topic}")
    return TOPICS[key]
