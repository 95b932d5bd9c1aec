"""What the messages of each topic hold, as flat JSON schemas that viewers read.

Viewers refuse or ignore references, unions, nullable types, arrays of arrays and arrays without item type; so
matrices are flat with their shape beside them, and what should plot is a named number at the top level. Every
message has `t`, the plant's time in s since its start. All numbers are SI.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

import orjson

from fdi_torch.logbook.errors import LogError

FORMAT_VERSION = "1"

Kind = Literal["number", "integer", "boolean", "text", "numbers", "integers", "texts", "time"]

_TIME = {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_JSON: dict[Kind, dict[str, Any]] = {
    "number": {"type": "number"},
    "integer": {"type": "integer"},
    "boolean": {"type": "boolean"},
    "text": {"type": "string"},
    "numbers": {"type": "array", "items": {"type": "number"}},
    "integers": {"type": "array", "items": {"type": "integer"}},
    "texts": {"type": "array", "items": {"type": "string"}},
    "time": _TIME,
}


@dataclass(frozen=True)
class Topic:
    """One kind of message. fields: name -> (kind, unit, meaning). named: may named numbers stand beside them?"""

    schema: str
    meaning: str
    fields: Mapping[str, tuple[Kind, str, str]] = field(default_factory=dict)
    named: bool = False


_EVENT: dict[str, tuple[Kind, str, str]] = {"problem": ("integer", "", "which of the batched problems")}

TOPICS: dict[str, Topic] = {
    "/plant/input": Topic("fdi_torch.plant_input", "what was commanded", named=True),
    "/plant/output": Topic(
        "fdi_torch.plant_output",
        "what was read",
        {"masked": ("texts", "", "readings that do not count")},
        named=True,
    ),
    "/plant/truth": Topic("fdi_torch.plant_truth", "true states and faults of a simulated plant", named=True),
    "/observer/residual": Topic(
        "fdi_torch.residual", "reading less observer's output; *_statistic, *_threshold where tested", named=True
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
        named=True,
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
        named=True,
    ),
    "/estimator/de/population": Topic(
        "fdi_torch.population",
        "state of the search: arrays as base64 of little-endian bytes, each with *_shape and *_dtype",
        {**_EVENT, "generation": ("integer", "", "0 is the first population")},
        named=True,
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
        named=True,
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
        named=True,
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
        named=True,
    ),
    "/gap/where": Topic(
        "fdi_torch.gap_where",
        "how likely it is that something is wrong at a component (answers of format 1: share of the gap it can close)",
        {
            "location": ("text", "", "component"),
            "share": ("number", "1", "probability"),
            "p_value": ("number", "1", "of no gap there"),
        },
        named=True,
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
            "unexamined": ("number", "1", "posterior of what was not examined"),
            "certain": ("texts", "", "effect@location, there with 95 % whatever else is"),
            "answer": ("text", "", "the whole answer as JSON text"),
        },
        named=True,
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
        named=True,
    ),
    "/study/summary": Topic(
        "fdi_torch.summary",
        "a setting of a study, summed up",
        {"group": ("text", "", "setting"), "trials": ("integer", "", "how many")},
        named=True,
    ),
    "/log": Topic(
        "foxglove.Log",
        "what was said during the run",
        {
            "timestamp": ("time", "", "plant time since 2000-01-01"),
            "level": ("integer", "", "1 debug, 2 info, 3 warning, 4 error, 5 fatal"),
            "message": ("text", "", "one sentence"),
            "name": ("text", "", "who said it"),
            "file": ("text", "", "unused"),
            "line": ("integer", "", "unused"),
        },
    ),
}


def topic_definition(topic: str) -> Topic:
    """The definition of a topic; `/plant/GROUP/input` is defined as `/plant/input`."""
    parts = topic.split("/")
    key = f"/{parts[1]}/{parts[3]}" if len(parts) == 4 and parts[1] == "plant" else topic
    if key not in TOPICS:
        raise ValueError(f"expected one of the topics {', '.join(TOPICS)}, got {topic}")
    return TOPICS[key]


class Fields(dict[str, Any]):
    """The fields of a message. One that is asked for by [] and is not there is said in a sentence."""

    def __init__(self, topic: str, fields: Mapping[str, Any]) -> None:
        super().__init__(fields)
        self.topic = topic

    def __missing__(self, name: str) -> Any:
        raise LogError(f"{self.topic}: expected a field {name} in every message, got one without it")


def conforming(topic: str, schema: str, fields: Mapping[str, Any]) -> Fields:
    """A message without what is not of the kind that its topic says: a log is written by whoever wrote it.

    Fields of the topic are of their kind, and `t` is a number; others are numbers, text or lists of these. Messages
    of other schemas stay as they are.
    """
    kinds = _kinds(topic, schema)
    if not kinds:
        return Fields(topic, fields)
    kept = {k: v for k, v in fields.items() if (_is_of(kinds[k], v) if k in kinds else _is_plain(v))}
    return Fields(topic, kept)


@lru_cache(maxsize=256)
def _kinds(topic: str, schema: str) -> dict[str, str]:
    """Kinds of a topic's own fields; nothing for another schema than its own."""
    definition = TOPICS.get(f"/plant/{topic.rpartition('/')[2]}" if topic.startswith("/plant/") else topic)
    if definition is None or definition.schema != schema:
        return {}
    return {"wall": "time", "t": "number"} | {name: kind for name, (kind, _, _) in definition.fields.items()}


_PYTHON: dict[str, tuple[type, ...]] = {
    "number": (float, int), "integer": (int,), "boolean": (bool,), "text": (str,), "time": (dict,),
    "numbers": (float, int), "integers": (int,), "texts": (str,),
}  # fmt: skip


def _is_of(kind: str, value: Any) -> bool:
    types = _PYTHON[kind]
    if kind.endswith("s"):
        return isinstance(value, list) and all(isinstance(item, types) for item in value)
    return isinstance(value, types)


def _is_plain(value: Any) -> bool:
    if type(value) is float or type(value) is int:
        return True
    plain = (bool, float, int, str)
    return isinstance(value, plain) or (isinstance(value, list) and all(isinstance(v, plain) for v in value))


def json_schema(definition: Topic, named: Mapping[str, Kind]) -> bytes:
    """The JSON schema of a topic whose messages have further fields of the given kinds."""
    properties: dict[str, Any] = {"t": {"type": "number", "description": "time since start, s"}}
    for name, (kind, unit, meaning) in definition.fields.items():
        properties[name] = {**_JSON[kind], "description": f"{meaning}, {unit}" if unit else meaning}
    properties.update({name: dict(_JSON[kind]) for name, kind in named.items()})
    properties["non_finite"] = {**_JSON["texts"], "description": "numbers JSON cannot hold, as name=nan"}
    properties["wall"] = {**_TIME, "description": "wall-clock time, where asked for"}
    schema = {
        "title": definition.schema,
        "description": definition.meaning,
        "type": "object",
        "properties": properties,
        "required": ["t"],
    }
    return orjson.dumps(schema)


def named_kinds(definition: Topic, schema: bytes) -> dict[str, Kind]:
    """Fields that a topic's schema has beyond the topic's own, and their kinds: what `json_schema` was given."""
    own = {"t", "non_finite", "wall", *definition.fields}
    kinds = {orjson.dumps(told): kind for kind, told in _JSON.items()}
    properties = orjson.loads(schema)["properties"]
    return {name: kinds[orjson.dumps(part)] for name, part in properties.items() if name not in own}


def viewer_problems(schema: Any, place: str = "schema") -> list[str]:
    """What in a JSON schema the common viewers cannot read; empty where all is well."""
    if not isinstance(schema, dict):
        return [f"{place}: expected an object, got {type(schema).__name__}"]
    banned = ("$ref", "anyOf", "oneOf", "allOf", "not", "if", "$defs", "definitions", "nullable")
    problems = [f"{place}: {word}" for word in banned if word in schema]
    kind = schema.get("type")
    if kind not in ("object", "array", "number", "integer", "boolean", "string"):
        problems.append(f"{place}: expected one plain type, got {kind}")
    if kind == "array":
        problems += _array_problems(schema.get("items"), place)
    return problems + _property_problems(schema.get("properties", {}), place)


def _array_problems(items: Any, place: str) -> list[str]:
    if not isinstance(items, dict):
        return [f"{place}: array without item type"]
    if items.get("type") in ("array", "object"):
        return [f"{place}: array of {items['type']}s"]
    return viewer_problems(items, f"{place}[]")


def _property_problems(properties: Mapping[str, Any], place: str) -> list[str]:
    return [problem for name, part in properties.items() for problem in viewer_problems(part, f"{place}.{name}")]
