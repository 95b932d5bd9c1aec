"""Words about a gap answer that terminal and page share: the models whose free runs it compares on its
hold-outs, and the random flows that people need to know of.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.scales import emptying_time
from fdi_torch.report.numbers import as_float

MODEL_NAMES = {
    "nominal": "nominal model",
    "recalibrated": "recalibrated",
    "augmented": "with the causes",
    "ceiling": "with free functions there",
    "noise_floor": "noise",
}


def has_causes(answer: Mapping[str, Any]) -> bool:
    """Whether the answer names anything, a place with an unknown cause included, that a model can be augmented with."""
    return answer.get("verdict") != "no_gap"


def reference_models(answer: Mapping[str, Any]) -> dict[str, str]:
    """Names of the compared models and of the noise, by their key in the closure of the answer."""
    if not has_causes(answer):
        return {key: MODEL_NAMES[key] for key in ("nominal", "recalibrated", "noise_floor")}
    if answer.get("verdict") == "unknown":
        compared = MODEL_NAMES | {"augmented": "with the free form"}
        return {key: name for key, name in compared.items() if key != "ceiling"}
    return MODEL_NAMES


SMALLEST_MOVE = 0.1
"""Standard deviation of a level, in those of the best sensor's noise. Less adds below 1 % to the readings' variance."""


def flows_that_matter(answer: Mapping[str, Any], plant: PlantDescription | None) -> dict[str, Mapping[str, Any]]:
    """Tank -> its random flow, if it moves the tank's level by more than `SMALLEST_MOVE`; all without a plant.

    A flow w that is constant moves the level of a tank by w T / A, with area A and emptying time T; a random flow of
    that standard deviation moves it by less. A tank without an outlet has no such bound, hence its flow matters.
    """
    flows = answer.get("disturbances")
    flows = {k: f for k, f in flows.items() if isinstance(f, Mapping)} if isinstance(flows, Mapping) else {}
    noise = answer.get("noise")
    if plant is None or not isinstance(noise, Mapping) or not noise:
        return flows
    gains = {sensor.name: abs(sensor.gain) for sensor in plant.sensors}
    stds = [as_float((noise.get(s) or {}).get("std")) / gain for s, gain in gains.items() if s in noise]
    best = min(stds, default=math.nan)
    tanks = {t.name: emptying_time(plant, t) / t.area for t in plant.tanks}
    return {
        name: flow
        for name, flow in flows.items()
        if name not in tanks or not as_float(flow.get("std")) * tanks[name] <= SMALLEST_MOVE * best
    }
