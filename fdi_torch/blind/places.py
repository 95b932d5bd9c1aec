"""Locations at which each effect can occur in a plant, and causes that count as equivalent."""

from __future__ import annotations

from fdi_torch.plant.description import OUTSIDE, PlantDescription

PUMP, PIPE, OUTLET, TANK, PAIR, SENSOR = "pump", "pipe", "outlet", "tank", "pair", "sensor"

# The vocabulary of a diagnosis: each effect and the components it can sit at.
EFFECTS: dict[str, tuple[str, ...]] = {
    "pump_gain": (PUMP,),
    "pump_dead_zone": (PUMP,),
    "pump_saturation": (PUMP,),
    "pump_lag": (PUMP,),
    "pump_delay": (PUMP,),
    "pump_back_pressure": (PUMP,),
    "laminar_flow": (PIPE, OUTLET),
    "flow_exponent": (PIPE, OUTLET),
    "outlet_drop": (OUTLET,),
    "coefficient_drift": (PIPE, OUTLET),
    "plugging": (PIPE, OUTLET),
    "cross_flow": (PAIR,),
    "leak": (TANK,),
    "unmetered_flow": (TANK,),
    "area_taper": (TANK,),
    "internal_body": (TANK,),
    "overflow": (TANK,),
    "sensor_bias": (SENSOR,),
    "sensor_gain": (SENSOR,),
    "sensor_lag": (SENSOR,),
    "sensor_drift": (SENSOR,),
    "sensor_quantization": (SENSOR,),
    "sensor_delay": (SENSOR,),
    "sensor_saturation": (SENSOR,),
}

Cause = tuple[str, str]


def places(plant: PlantDescription, kinds: tuple[str, ...]) -> tuple[str, ...]:
    """The locations of these kinds. A tank pair counts only if no known pipe connects the two tanks."""
    outlets = [p.name for p in plant.pipes if p.is_outlet]
    joined = [{p.source, p.target} for p in plant.pipes]
    by_kind = {
        PUMP: [p.name for p in plant.pumps],
        PIPE: [p.name for p in plant.pipes if p.name not in outlets],
        OUTLET: outlets,
        TANK: [t.name for t in plant.tanks],
        PAIR: [f"{a}-{b}" for a, b in plant.tank_pairs() if {a, b} not in joined],
        SENSOR: [s.name for s in plant.sensors],
    }
    return tuple(name for kind in kinds for name in by_kind[kind])


def effect_places(plant: PlantDescription) -> tuple[Cause, ...]:
    """Every effect at every possible location: 62 in the three-tank plant."""
    return tuple((effect, place) for effect, kinds in EFFECTS.items() for place in places(plant, kinds))


def canonical(cause: Cause, plant: PlantDescription) -> Cause:
    """The canonical name of a cause: a leak at the floor and a wider outlet of the same tank are both called leak."""
    effect, location = cause
    if effect == "plugging":
        for pipe in plant.pipes:
            if pipe.name == location and pipe.target == OUTSIDE:
                return "leak", pipe.source
    return cause


# Effects that much of the data cannot tell apart at one place.
TWINS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("pump_lag", "pump_delay"), PUMP),
    (("sensor_lag", "sensor_delay"), SENSOR),
    (("laminar_flow", "flow_exponent", "outlet_drop"), OUTLET),
    (("laminar_flow", "flow_exponent"), PIPE),
    (("plugging",), OUTLET),
)


def are_twins(a: Cause, b: Cause, plant: PlantDescription) -> bool:
    """Whether two causes are equivalent, or nearly collinear at one location."""
    if canonical(a, plant) == canonical(b, plant):
        return True
    return a[1] == b[1] and any(a[0] in family and b[0] in family for family, _ in TWINS)
