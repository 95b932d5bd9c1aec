"""The rigs of the blind benchmark, with their own numbers: nothing is read from the library's plant files.

The benchmark draws sizes of faults, noise levels and durations for rigs of bench size. A rig of another size or speed
is scaled to bench size and simulated there, and its recording is scaled back. The scale factors are `length` for
lengths, `time` for times and `area` for cross-sections of tanks. The balance A dh/dt = q and the orifice law q = C_d a
sqrt(2 g h) keep their form if flows are scaled by area x length / time, and cross-sections a of pipes by area x
sqrt(length) / time. All factors are powers of ten, so that recordings of every size have the same digits: samples at
round times, and readings with equally many digits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import geometric_mean

from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import OUTSIDE, Pipe, PlantDescription, Pump, Sensor, Tank

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


CM, CM2, CM3 = 1e-2, 1e-4, 1e-6


@dataclass(frozen=True)
class Rig:
    """A plant and how it is exercised.

    plant: on the bench. full_size: the plant that is diagnosed, where that is of another size; scales: how much larger.
    input_low, input_high: range of the commanded flow as a share of a pump's max_flow, for ordinary inputs.
    noise_unit: m; noise levels are drawn as 0.05, 0.1 or 0.2 of it.
    lowest, highest: shares of the rim between which the rig without any effect has to stay. rest (N,) m: its levels
    at middling inputs, where they are known.
    """

    plant: PlantDescription
    input_low: float = 0.13
    input_high: float = 0.8
    noise_unit: float = 1.0 * CM
    full_size: PlantDescription | None = None
    scales: Scales = BENCH
    lowest: float = 0.0
    highest: float = 0.85
    rest: tuple[float, ...] | None = None

    @property
    def name(self) -> str:
        return self.plant.name

    @property
    def believed(self) -> PlantDescription:
        """The plant file for the diagnosis."""
        return self.full_size or self.plant

    @property
    def measured_tanks(self) -> list[int]:
        """Index of the tank that each sensor measures."""
        tanks = [t.name for t in self.plant.tanks]
        return [tanks.index(s.tank) for s in self.plant.sensors]

    def __post_init__(self) -> None:
        if not 0 <= self.input_low < self.input_high <= 1:
            raise ValueError(
                f"rig {self.plant.name}: expected 0 <= input_low < input_high <= 1, "
                f"got {self.input_low} and {self.input_high}; give both as shares of max_flow"
            )
        if any(pipe.valve for pipe in self.plant.pipes):
            raise ValueError(f"rig {self.plant.name}: expected pipes without valves, got a valve; leave it out")
        if self.plant.effects:
            names = ", ".join(f"{e.effect} at {e.location}" for e in self.plant.effects)
            raise ValueError(f"rig {self.plant.name}: expected a plant without effects, got {names}; leave them out")
        if not self.plant.pumps or not self.plant.sensors:
            raise ValueError(f"rig {self.plant.name}: expected pumps and sensors, got none; add at least one of each")


def _coefficient_tolerances(pipes: tuple[Pipe, ...]) -> dict[str, float]:
    return {f"{pipe.name}.discharge_coefficient": 0.03 for pipe in pipes}


def three_tank() -> Rig:
    """Three tanks in a row: Q1 -> T1 -> P13 -> T3 -> P32 -> T2 -> OUT2, Q2 -> T2."""
    area, bore = 160 * CM2, 0.6 * CM2
    tanks = tuple(Tank(name, area, 1.0, leak_reference="P13") for name in ("T1", "T2", "T3"))
    pipes = (
        Pipe("P13", "T1", "T3", bore, 0.6),
        Pipe("P32", "T3", "T2", bore, 0.6),
        Pipe("OUT2", "T2", OUTSIDE, bore, 0.6),
    )
    pumps = (Pump("Q1", "T1", 90 * CM3), Pump("Q2", "T2", 90 * CM3))
    sensors = (Sensor("h1", "T1"), Sensor("h2", "T2"), Sensor("h3", "T3"))
    plant = PlantDescription(
        "three_tank", tanks, pipes, pumps, sensors, tolerances=_coefficient_tolerances(pipes), gravity=9.81
    )
    return Rig(plant)


def quadruple_tank() -> Rig:
    """Four tanks, two pumps split over an upper and a lower tank each (layout of Johansson, 2000).

    A split pump is written as two pumps on one command.
    """
    sizes = {"T1": 28 * CM2, "T2": 32 * CM2, "T3": 28 * CM2, "T4": 32 * CM2}
    tanks = tuple(Tank(name, area, 0.4, leak_reference="O1") for name, area in sizes.items())
    pipes = (
        Pipe("O1", "T1", OUTSIDE, 0.071 * CM2, 0.95),
        Pipe("O2", "T2", OUTSIDE, 0.057 * CM2, 0.95),
        Pipe("O3", "T3", "T1", 0.033 * CM2, 0.95, free_fall=True),
        Pipe("O4", "T4", "T2", 0.028 * CM2, 0.95, free_fall=True),
    )
    gain_a, gain_b = 3.33 * CM3, 3.35 * CM3
    pumps = (
        Pump("A1", "T1", 0.70 * 6 * gain_a, 0.70 * gain_a, "vA", "m^3/s/V"),
        Pump("A4", "T4", 0.30 * 6 * gain_a, 0.30 * gain_a, "vA", "m^3/s/V"),
        Pump("B2", "T2", 0.60 * 6 * gain_b, 0.60 * gain_b, "vB", "m^3/s/V"),
        Pump("B3", "T3", 0.40 * 6 * gain_b, 0.40 * gain_b, "vB", "m^3/s/V"),
    )
    sensors = tuple(Sensor(f"h{i}", f"T{i}") for i in (1, 2, 3, 4))
    plant = PlantDescription("quadruple_tank", tanks, pipes, pumps, sensors, tolerances=_coefficient_tolerances(pipes))
    return Rig(plant, 0.25, 0.75, 0.4 * CM)


def cascaded_tanks() -> Rig:
    """One pump, an upper tank flowing into a lower one, both measured."""
    tanks = (Tank("T1", 50 * CM2, 0.5, leak_reference="O1"), Tank("T2", 50 * CM2, 0.5, leak_reference="O2"))
    pipes = (
        Pipe("O1", "T1", "T2", 0.30 * CM2, 0.7, free_fall=True),
        Pipe("O2", "T2", OUTSIDE, 0.30 * CM2, 0.7),
    )
    pumps = (Pump("Q", "T1", 60 * CM3),)
    sensors = (Sensor("h1", "T1"), Sensor("h2", "T2"))
    plant = PlantDescription("cascaded_tanks", tanks, pipes, pumps, sensors, tolerances=_coefficient_tolerances(pipes))
    return Rig(plant, 0.25, 0.8, 0.5 * CM)


RIGS = {"three_tank": three_tank, "quadruple_tank": quadruple_tank, "cascaded_tanks": cascaded_tanks}
