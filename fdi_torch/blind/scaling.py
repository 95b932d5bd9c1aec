"""Conversion of a rig of any size and speed to bench size, for which the benchmark's absolute amounts are chosen.

The units are `length` m for lengths, `time` s for times and `area` m^2 for cross-sections of tanks. The balance
A dh/dt = q and the orifice law q = C_d a sqrt(2 g h) keep their form if flows are measured in area x length / time and
cross-sections a of pipes in area x sqrt(length) / time. All units are powers of ten, so that a recording of another
size has the same digits: its samples are at round times, and its readings have as many digits as on the bench.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import geometric_mean

from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription, Pump, Sensor

BENCH_HEIGHT, BENCH_AREA = 0.5, 0.01  # m, m^2


@dataclass(frozen=True)
class Scales:
    """Scale factors from bench to rig: s, m and m^2 at the rig for one second, metre and square metre on the bench."""

    time: float = 1.0
    length: float = 1.0
    area: float = 1.0

    @property
    def flow(self) -> float:
        return self.area * self.length / self.time

    @property
    def bore(self) -> float:
        return self.area * math.sqrt(self.length) / self.time

    def command(self, pump: Pump) -> float:
        """Scale factor of a pump's command: that of a flow if commands are flows, otherwise 1."""
        return self.flow if pump.gain_unit == "1" else 1.0

    def as_dict(self) -> dict[str, float]:
        return {"time_s": self.time, "length_m": self.length, "area_m2": self.area}


BENCH = Scales()


def scales_of(plant: PlantDescription, time_scale: float) -> Scales:
    """The powers of ten nearest to the size of a plant, and to its time scale, s, that of the bench being 1 s."""
    height = geometric_mean(tank.height / BENCH_HEIGHT for tank in plant.tanks)
    area = geometric_mean(tank.area / BENCH_AREA for tank in plant.tanks)
    return Scales(*(10.0 ** round(math.log10(ratio)) for ratio in (time_scale, height, area)))


def decimals(on_bench: int, scale: float) -> int:
    """Number of printed decimals at the rig that is equivalent to `on_bench` decimals on the bench."""
    return max(on_bench - round(math.log10(scale)), 0)


def on_bench(plant: PlantDescription, scales: Scales) -> PlantDescription:
    """The dynamically similar plant at bench scale; readings in volts and similar units are unchanged."""
    return replace(
        plant,
        tanks=tuple(
            replace(
                t,
                area=t.area / scales.area,
                height=t.height / scales.length,
                start_level=None if t.start_level is None else t.start_level / scales.length,
            )
            for t in plant.tanks
        ),
        pipes=tuple(replace(p, area=p.area / scales.bore, elevation=p.elevation / scales.length) for p in plant.pipes),
        pumps=tuple(
            replace(p, max_flow=p.max_flow / scales.flow, gain=p.gain / scales.flow * scales.command(p))
            for p in plant.pumps
        ),
        sensors=tuple(_sensor(s, scales) for s in plant.sensors),
        tolerances={name: t / _unit_of(plant, name, scales) for name, t in plant.tolerances.items()},
    )


def _sensor(sensor: Sensor, scales: Scales) -> Sensor:
    if sensor.unit != "m":
        return replace(sensor, gain=sensor.gain * scales.length)
    low, high = (None if end is None else end / scales.length for end in (sensor.low, sensor.high))
    return replace(sensor, offset=sensor.offset / scales.length, low=low, high=high)


def _unit_of(plant: PlantDescription, constant: str, scales: Scales) -> float:
    """Tolerances of offsets are in the reading's unit, all others are relative."""
    name = ParameterName.parse(constant)
    sensor = next((s for s in plant.sensors if s.name == name.prefix), None)
    return scales.length if name.field == "offset" and sensor is not None and sensor.unit == "m" else 1.0
