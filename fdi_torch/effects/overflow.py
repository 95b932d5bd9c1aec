"""A tank that overflows below its rim, or through a notch in it."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from fdi_torch.plant.effect import Effect, Local, OperatingRange, Parameter, PlantDescription, Stage, Values
from fdi_torch.plant.operating_range import interior_points
from fdi_torch.plant.orifice import rim_strength, weir_flow


class Overflow(Effect):
    """The weir law with a crest at H - b, less the law at the rim, times the length of the crest relative to the rim.
    Shares of the overflow can go to other tanks, by default to where that of the rim goes; the rest leaves the plant.
    Shares whose sum exceeds 1 are divided by it.

    Typical: an overflow pipe 5 to 20 cm below the rim, a crest of 1 to 100 % of it. No effect below the crest.
    """

    name = "overflow"
    stage = Stage.BALANCE
    places = ("tank",)
    smooth = False
    mistaken_for = ("pump_cut_out", "sensor_saturation", "leak", "pump_saturation")

    def parameters(self, place: str, plant: PlantDescription) -> tuple[Parameter, ...]:
        tank = plant.tank(place)
        into = [
            Parameter(
                f"to_{t.name}",
                "1",
                float(t.name == tank.overflow_to),
                0.0,
                1.0,
                meaning=f"share that {t.name} receives",
            )
            for t in plant.tanks
            if t.name != place
        ]
        return (
            Parameter("below_rim", "m", 0.0, 0.0, 0.95 * tank.height, meaning="depth of the crest below the rim"),
            Parameter("crest", "1", 1.0, 1e-2, 1.0, meaning="length of the crest relative to the rim"),
            *into,
        )

    def starts(self, place: str, plant: PlantDescription, operating_range: OperatingRange) -> list[dict[str, float]]:
        tank = plant.tank(place)
        low, high = operating_range.levels[place]
        depths = [tank.height - level for level in (*interior_points((low, high), 6), high)]
        above = _above(place, plant)
        others = [t.name for t in plant.tanks if t.name not in (place, tank.overflow_to, *above)]
        usual = {f"to_{t.name}": 0.2 for t in plant.tanks if t.name == tank.overflow_to}
        shares = [{}, *({f"to_{name}": 0.7} | usual for name in others)]
        return [{"below_rim": max(d, 0.0), "crest": 0.03} | share for d in depths for share in shares]

    def inflow(self, local: Local, p: Values) -> torch.Tensor:
        over_rim = local.level - local.height
        return self._weir(over_rim, local, p["crest"]) - self._weir(over_rim + p["below_rim"], local, p["crest"])

    def recipients(self, p: Values) -> Mapping[str, torch.Tensor]:
        shares = {name.removeprefix("to_"): share for name, share in p.items() if name.startswith("to_")}
        whole = torch.clamp(sum(shares.values(), torch.zeros_like(p["crest"])), min=1.0)
        return {name: share / whole for name, share in shares.items()}

    def _weir(self, above: torch.Tensor, local: Local, crest: torch.Tensor) -> torch.Tensor:
        area = local.constants["area"]
        strength = rim_strength(area, local.gravity) * crest
        return weir_flow(above, local.net, area, strength, local.clock.resolution)


def _above(place: str, plant: PlantDescription) -> set[str]:
    """The tanks that drain into this one in free fall, directly or through others; they cannot receive its overflow."""
    upstream: set[str] = set()
    while new := {p.source for p in plant.pipes if p.free_fall and p.target in {place, *upstream}} - upstream:
        upstream |= new
    return upstream
