"""The models whose free runs a gap diagnosis compares on its hold-outs, in words, for terminal and page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_NAMES = {
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
    """Names of the models by their key in the closure, and of the noise. The free form of an unknown cause is the best
    that free functions can reach.
    """
    if not has_causes(answer):
        return {key: _NAMES[key] for key in ("nominal", "recalibrated", "noise_floor")}
    if answer.get("verdict") == "unknown":
        return {key: name for key, name in _NAMES.items() if key != "ceiling"} | {"augmented": "with the free form"}
    return _NAMES
