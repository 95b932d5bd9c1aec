"""The faults that a monitor watches for unless others are named."""

from __future__ import annotations

from fdi_torch.plant.description import FLOW_KINDS, PlantDescription


def usual_faults(plant: PlantDescription) -> list[str]:
    """A leak of each tank, the usual faults of each flow component, and bias, gain and freezing of each sensor."""
    leaks = [f"{tank.name}.leak.size" for tank in plant.tanks]
    flows = [
        f"{component.name}.{fault}"
        for kind in FLOW_KINDS
        for fault in kind.usual_faults
        for component in getattr(plant, kind.part())
    ]
    wrong = ("sensor_bias.bias", "sensor_gain.factor", "sensor_stuck.size")
    return leaks + flows + [f"{sensor.name}.{fault}" for fault in wrong for sensor in plant.sensors]
