"""The constants whose tolerances a fit ignores because it does not estimate them."""

from __future__ import annotations

from collections.abc import Collection

from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription, uncertain_constants


def exact_constants_sentence(plant: PlantDescription, estimated: Collection[str], constants: Collection[str]) -> str:
    """Say which uncertain constants count as exact, and the key that estimates them; '' if all are estimated.

    estimated: names of the estimated parameters. constants: of all constants of the network. A pattern such as
    *.discharge_coefficient stands for several constants if it matches no other one.
    """
    exact = uncertain_constants(plant, estimated)
    fields = {name: ParameterName.parse(name).field for name in exact}
    patterns: dict[str, None] = {}
    for name, field in fields.items():
        matched = [constant for constant in constants if constant.endswith(f".{field}")]
        common = len(matched) > 1 and all(constant in fields for constant in matched)
        patterns[f'"*.{field}"' if common else name] = None
    if not patterns:
        return ""
    return f"constants with a tolerance count as exact here; estimate.calibrate: [{', '.join(patterns)}] estimates them"
