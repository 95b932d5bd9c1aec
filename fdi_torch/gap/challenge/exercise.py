"""How a rig that only its plant file describes is exercised: inputs that fill it half, noise of a usual size."""

from __future__ import annotations

from dataclasses import replace

from fdi_torch.gap.challenge.bench import SAME, Scales, on_bench
from fdi_torch.gap.challenge.conditions import levels_at_rest
from fdi_torch.gap.challenge.plants import Rig
from fdi_torch.plant.description import PlantDescription

LOW, HIGH = 0.13, 0.8
FULL, LEAST = 0.5, 0.02
NOISE = 1 / 35
"""Of the mean level at rest, as in the three tanks: readings are then noisy by 0.14, 0.29 or 0.57 % of it."""


def exercised(plant: PlantDescription, scales: Scales = SAME) -> Rig:
    """The rig with the widest inputs, in steps of a tenth, at whose middle no tank rests above half its height.

    scales: how much larger and slower it is than a rig on a bench. Cases are made there and recorded at the
    plant's own size and pace: a water tower's recording lasts for days.

    Raises ValueError for valves, for a rig without pumps or sensors, and where every input overfills it.
    """
    rig = Rig(on_bench(plant, scales), LOW, HIGH, full_size=plant, scales=scales)
    while ((rest := levels_at_rest(rig)) > [FULL * t.height for t in rig.plant.tanks]).any():
        rig = replace(rig, input_low=0.9 * rig.input_low, input_high=0.9 * rig.input_high)
        if rig.input_high < LEAST:
            raise ValueError(
                f"plant {plant.name}: expected inputs at which no tank rests above half its height, got none above "
                f"{100 * LEAST:.0f} % of max_flow; check that every tank drains"
            )
    return replace(rig, noise_unit=NOISE * float(rest.mean()))
