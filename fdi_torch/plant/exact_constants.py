"""The constants that a fit counts as exact because it does not estimate them."""

from __future__ import annotations

from collections.abc import Collection

from fdi_torch.names import listed
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription, uncertain_constants

MOST_LISTED = 6


def exact_constants_sentence(plant: PlantDescription, estimated: Collection[str], constants: Collection[str]) -> str:
    """Say which uncertain constants count as exact, and the key that estimates them; '' if all are estimated.

    estimated: names of the estimated parameters. constants: of all constants of the network.
    """
    patterns = _patterns(uncertain_constants(plant, estimated), constants)
    if not patterns:
        return ""
    return f"constants with a tolerance count as exact here; estimate.calibrate: [{', '.join(patterns)}] estimates them"


def without_tolerance_sentence(plant: PlantDescription, estimated: Collection[str], constants: Collection[str]) -> str:
    """Say which constants count as exact because the plant file gives them no tolerance; '' if all have one.

    These are the areas of the tanks and, of each flow of which no constant has a tolerance or is estimated, the last
    one, which is the factor of its law: the discharge coefficient of a pipe, the gain of a pump.
    """
    uncertain = {*plant.tolerances, *estimated}
    groups = [[f"{tank.name}.area"] for tank in plant.tanks]
    groups += [
        [f"{flow.name}.{name}" for name, _, role in flow.constants() if role == "estimated"]
        for flow in plant.flow_components()
    ]
    patterns = _patterns([group[-1] for group in groups if group and not uncertain.intersection(group)], constants)
    if not patterns:
        return ""
    more = [f"{len(patterns) - MOST_LISTED} more"] if len(patterns) > MOST_LISTED else []
    shown = listed([*patterns[:MOST_LISTED], *more])
    return (
        f"constants without a tolerance count as exact, and an error of one may look like this fault: {shown}; list "
        f"the uncertain ones in the plant file, as in tolerances: {{{patterns[0]}: 5 %}}"
    )


def _patterns(names: Collection[str], constants: Collection[str]) -> list[str]:
    """The names; a pattern such as "*.discharge_coefficient" stands for several if it matches no other constant."""
    fields = {name: ParameterName.parse(name).field for name in names}
    patterns: dict[str, None] = {}
    for name, field in fields.items():
        matched = [constant for constant in constants if constant.endswith(f".{field}")]
        common = len(matched) > 1 and all(constant in fields for constant in matched)
        patterns[f'"*.{field}"' if common else name] = None
    return list(patterns)
