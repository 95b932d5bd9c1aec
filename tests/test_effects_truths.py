"""Single effects against closed forms and independent calculations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from rigs import blank_recording, constant_inputs, three_tank
from torch import Tensor

from fdi_torch.effects import build_network, effect, placements_for
from fdi_torch.effects.coefficient_drift import elapsed
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import Pipe, PlacedEffect, PlantDescription, Sensor, Tank
from fdi_torch.plant.effect import Effect, Local, Memory, Placement
from fdi_torch.plant.operating_range import bounded_by_recording, head_range, interior_points, operating_range_of
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.experiment import lay_out
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.simulated_recording import quantized


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def values(**parameters: float) -> dict[str, Tensor]:
    return {name: number(value) for name, value in parameters.items()}


def local(head: float, level: float = 0.5) -> Local:
    """A place with 1 m^2.5/s of capacity under a tank 1 m tall, roots drawn smooth below 1e-9 m."""
    one, zero, clock = number(1.0), number(0.0), Clock(number(0.0), number(1.0), number(1.0))
    constants = {"area": number(0.01), "max_flow": number(1e-4)}
    flow = (number(head), one, one, zero, number(1e-9))
    return Local(clock, number(level), zero, *flow, height=one, area=one, gravity=number(9.81), constants=constants)


def through(actuator: Effect, commands: list[float], step: float, p: dict[str, Tensor]) -> list[float]:
    """What a chain of held commands, each one step long, becomes."""
    memory: Memory = actuator.steady_memory(number(commands[0]), p)
    out = []
    for k, u in enumerate(commands):
        clock = Clock(number(k * step), number(step), number(step))
        value, memory = actuator.command(number(u), memory, clock, p)
        out.append(float(value))
    return out


def read(sensor: Effect, seen: list[float], step: float, p: dict[str, Tensor]) -> list[float]:
    memory: Memory = sensor.steady_memory(number(seen[0]), p)
    out = []
    for k, y in enumerate(seen):
        clock = Clock(number((k - 1) * step), number(step), number(step))
        value, memory = sensor.reading(number(y), memory, clock, p)
        out.append(float(value))
    return out


def test_pump_lag_passes_on_the_exact_mean_whatever_the_step() -> None:
    p, lag = values(time_constant=8.0), effect("pump_lag")
    # 1 - exp(-t/8) from t = 0 to 20, averaged: 1 - (8/20) (1 - exp(-2.5))
    expected = 1.0 - 0.4 * (1.0 - math.exp(-2.5))
    assert through(lag, [0.0, 1.0], 20.0, p)[1] == pytest.approx(expected, rel=1e-14)
    fine = through(lag, [0.0, *[1.0] * 40], 0.5, p)[1:]
    assert sum(fine) / 40 == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("step", [0.5, 1.0, 3.0])
def test_a_hose_takes_its_own_volume_once_whatever_the_step(step: float) -> None:
    """2 for 6 s, rest for 6 s, 2 for 6 s through a hose of 5: the second stroke loses nothing."""
    stroke, rest = [2.0] * round(6.0 / step), [0.0] * round(6.0 / step)
    sent = [0.0, *stroke, *rest, *stroke]
    out = through(effect("pump_priming"), sent, step, values(volume=5.0, passed=0.0, ran_for=10.0))
    assert sum(out) * step == pytest.approx(sum(sent) * step - 5.0)
    assert out[-len(stroke) :] == stroke and out[0] == 0.0
    running = through(effect("pump_priming"), stroke, step, values(volume=5.0, passed=0.0, ran_for=10.0))
    assert running == stroke  # a pump that runs at the first sample has a full hose
    trickle = through(effect("pump_priming"), [0.1, *stroke], step, values(volume=5.0, passed=0.0, ran_for=10.0))
    assert sum(trickle) * step == pytest.approx(12.0 + 0.1 * step - 4.0)  # 0.1 for 10 s before has filled 1 of 5
    beside = through(effect("pump_priming"), sent, step, values(volume=5.0, passed=0.5, ran_for=10.0))
    # A half fills the hose: full after 5 s, so that of the 12 of the first stroke 5 + 2 have arrived.
    assert sum(beside[1 : 1 + len(stroke)]) * step == pytest.approx(7.0)
    assert beside[1] == pytest.approx(1.0) and beside[-len(stroke) :] == stroke


def test_sensor_lag_stays_a_time_constant_behind_a_ramp() -> None:
    seen = read(effect("sensor_lag"), [0.3 * k for k in range(200)], 1.0, values(time_constant=7.0))
    assert seen[-1] == pytest.approx(0.3 * 199 - 0.3 * 7.0, rel=1e-9)
    early = 0.3 * 5 - 0.3 * 7.0 * (1.0 - math.exp(-5.0 / 7.0))
    assert seen[5] == pytest.approx(early, rel=1e-12)


def test_slew_moves_at_its_rate_and_stops_at_the_command() -> None:
    # A whole stroke takes 10 s: after 4 s it is at 0.4, after 8 s at 0.8; it arrives in the middle of the third step.
    means = through(effect("actuator_slew"), [0.0, 1.0, 1.0, 1.0, 1.0], 4.0, values(slowness=10.0))
    assert means == pytest.approx([0.0, 0.2, 0.6, 0.95, 1.0], rel=1e-12)


def test_stuck_actuator_and_sensor_keep_what_they_had_at_the_onset() -> None:
    ramp = [float(k) for k in range(6)]
    p = values(size=1.0, onset=3.0)
    assert through(effect("actuator_stuck"), ramp, 1.0, p) == [0.0, 1.0, 2.0, 2.0, 2.0, 2.0]
    assert read(effect("sensor_stuck"), ramp, 1.0, p) == [0.0, 1.0, 2.0, 2.0, 2.0, 2.0]


def test_hysteresis_follows_half_its_band_behind() -> None:
    up_and_down = [0.0, 1.0, 2.0, 1.8, 1.0, 0.0]
    assert read(effect("sensor_hysteresis"), up_and_down, 1.0, values(play=0.25)) == [0.0, 0.75, 1.75, 1.75, 1.25, 0.25]


def test_bias_is_there_from_its_onset_and_rises_along_its_ramp() -> None:
    bias, flat = effect("sensor_bias"), [0.0] * 7
    assert read(bias, flat, 1.0, values(bias=2.0, onset=3.0, ramp=0.0)) == [0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 2.0]
    ramp = read(bias, flat, 1.0, values(bias=2.0, onset=1.0, ramp=3.0))
    assert ramp == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.0, 2.0])


@pytest.mark.parametrize(("onset", "ramp"), [(3.2, 0.0), (3.2, 0.5), (1.0, 25.0), (-4.0, 9.0), (-1e30, 4.0)])
def test_a_rise_is_averaged_exactly(onset: float, ramp: float) -> None:
    clock = Clock(number(2.0), number(5.0), number(5.0))
    fine = 2.0 + 5.0 * (torch.arange(200000, dtype=torch.float64) + 0.5) / 200000
    rise = torch.clamp((fine - onset) / ramp, 0.0, 1.0) if ramp else (fine > onset).double()
    assert float(clock.risen(number(onset), number(ramp))) == pytest.approx(float(rise.mean()), abs=1e-5)


def test_a_sine_is_averaged_exactly() -> None:
    clock = Clock(number(2.0), number(5.0), number(5.0))
    w, phase = 2.0 * math.pi / 17.0, 0.4
    exact = (math.cos(w * 2.0 + phase) - math.cos(w * 7.0 + phase)) / (w * 5.0)
    assert float(clock.sine(number(17.0), number(phase))) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("head", [1e-4, -1e-4])
def test_laminar_flow_is_linear_below_its_head_and_torricellian_above(head: float) -> None:
    law = effect("laminar_flow")
    for softness in (0.5, 0.2, 0.002):
        shape = {"softness": softness}
        low = law.flow(local(head).root(number(head)), local(head), values(transition_head=1.0, **shape))
        assert float(low) == pytest.approx(head, rel=1e-3)
        high = law.flow(number(1.0), local(1.0), values(transition_head=1e-4, **shape))
        assert float(high) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize(
    ("head_0", "softness", "law", "off"),
    [
        (0.1, 0.5, lambda x: 1.0 / math.sqrt(1.0 + 1.0 / x), 1e-5),
        (0.104, 0.37, lambda x: math.tanh(math.sqrt(x)), 0.02),  # a coefficient that rises with the Reynolds number
        (0.1, 0.002, lambda x: min(1.0, math.sqrt(x)), 1e-5),  # linear below one head
    ],
)
def test_the_softness_of_a_laminar_transition_holds_other_known_laws(
    head_0: float, softness: float, law: Callable[[float], float], off: float
) -> None:
    for head in (0.005, 0.02, 0.08, 0.16, 0.32):
        p = values(transition_head=head_0, softness=softness)
        factor = float(effect("laminar_flow").flow(number(1.0), local(head), p))
        assert factor == pytest.approx(law(head / 0.1), rel=off)


@pytest.mark.parametrize("level", [0.97, 0.99, 1.0, 1.01, 1.03])
@pytest.mark.parametrize("behind", [0.0, 1.0])
def test_a_clipped_noisy_reading_reads_what_it_does_in_the_mean(level: float, behind: float) -> None:
    noise = 0.01 * torch.randn(200000, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    before = min(level, 1.0) if behind else level
    p, clock = values(limit=1.0, noise=0.01, behind=behind), Clock(number(0.0), number(1.0), number(1.0))
    seen = float(effect("sensor_saturation").reading(number(level), (), clock, p)[0])
    assert seen == pytest.approx(float((before + noise).clamp(max=1.0).mean()), abs=2.5e-4)
    below = float(effect("sensor_floor").reading(number(-level), (), clock, p | values(limit=-1.0))[0])
    assert below == pytest.approx(-seen, rel=1e-12)


def test_a_narrow_gap_between_tanks_is_linear_near_equal_levels_and_torricellian_far_from_them() -> None:
    law, p = effect("cross_flow"), values(size=0.5, height=0.0, transition_head=0.002)
    for head in (1e-6, -1e-6):
        here = replace(local(head), level=number(0.3 + head), far_level=number(0.3))
        assert float(law.inflow(here, p)) == pytest.approx(0.5 * head / math.sqrt(0.002), rel=2e-2)
    far = replace(local(0.5), level=number(0.8), far_level=number(0.3))
    assert float(law.inflow(far, p)) == pytest.approx(0.5 * math.sqrt(0.5), rel=0.02)
    for head in (5e-4, 2e-3, 8e-3, 0.03, 0.12):  # head = a q + b q^2
        here = replace(local(head), level=number(0.3 + head), far_level=number(0.3))
        exact = 0.5 * head / (0.5 * math.sqrt(0.002) + math.sqrt(head + 0.25 * 0.002))
        assert float(law.inflow(here, p)) == pytest.approx(exact, rel=0.09)


@pytest.mark.parametrize(("level", "left"), [(0.1, 0.02), (0.22, 0.0122), (0.3, 0.013), (0.38, 0.0138), (0.5, 0.02)])
def test_a_heap_takes_up_less_towards_its_top(level: float, left: float) -> None:
    heap = values(area=0.008, bottom=0.2, height=0.2, narrowing=0.25)
    area = effect("internal_body").area(number(0.02), replace(local(0.5), level=number(level)), heap)
    assert float(area) == pytest.approx(left, rel=1e-9)


def test_a_curved_sensor_is_right_at_half_the_height_and_wrong_by_the_square_of_the_distance() -> None:
    plant = replace(three_tank(), sensors=(Sensor("h1", "T1", gain=2.0, offset=0.1),))
    curvature, clock = effect("sensor_curvature"), Clock(number(0.0), number(1.0), number(1.0))
    nominal = {p.name: number(p.nominal) for p in curvature.parameters("h1", plant)}
    p = nominal | values(bend=0.3)
    wrong = [
        float(curvature.reading(number(2.0 * h + 0.1), (), clock, p)[0]) - (2.0 * h + 0.1) for h in (0.5, 0.6, 0.4)
    ]
    assert wrong == pytest.approx([0.0, 0.3 * 0.2**2, 0.3 * 0.2**2])


def test_a_drifting_sensor_is_wrong_by_its_rate_times_the_time_of_the_reading() -> None:
    assert read(effect("sensor_drift"), [0.0] * 4, 2.0, values(rate=1e-3)) == pytest.approx([0.0, 2e-3, 4e-3, 6e-3])


def test_a_leak_above_the_floor_has_the_head_above_it_and_none_before_it_opens() -> None:
    def lost(level: float, onset: float) -> float:
        here = replace(local(level, level), clock=Clock(number(10.0), number(2.0), number(2.0)))
        return -float(effect("leak").inflow(here, values(size=0.1, height=0.2, onset=onset, ramp=0.0)))

    full = 0.1 * math.sqrt(0.36 - 0.2)
    assert [lost(0.36, 0.0), lost(0.36, 11.0), lost(0.36, 12.0)] == pytest.approx([full, 0.5 * full, 0.0])
    assert lost(0.15, 0.0) == pytest.approx(0.0, abs=1e-9)


def test_a_path_between_two_tanks_passes_what_is_above_it() -> None:
    def passed(near: float, far: float) -> float:
        here = replace(local(near, near), far_level=number(far))
        return float(effect("cross_flow").inflow(here, values(size=0.1, height=0.3, transition_head=0.0)))

    flows = [passed(0.5, 0.46), passed(0.46, 0.5), passed(0.39, 0.1), passed(0.2, 0.1)]
    assert flows == pytest.approx([0.1 * 0.2, -0.1 * 0.2, 0.1 * 0.3, 0.0], abs=1e-6)


def test_a_bent_pump_curve_meets_the_line_at_rest_and_at_full_flow() -> None:
    flows = [float(effect("pump_curve").flow(number(q), local(0.5), values(bend=0.4))) for q in (0.0, 2e-5, 5e-5, 1e-4)]
    assert flows == pytest.approx([0.0, 2e-5 * (1.0 + 0.4 * 0.8), 5e-5 * 1.2, 1e-4])


def test_a_limited_pump_has_a_kink_or_a_knee() -> None:
    full, limit = 1e-4, 5e-5
    for flow in (0.0, 1e-5, 4e-5, 5e-5, 8e-5):
        here = local(0.1)
        hard = effect("pump_saturation").flow(number(flow), here, values(limit=limit, knee=0.0))
        assert float(hard) == min(flow, limit)
        soft = effect("pump_saturation").flow(number(flow), here, values(limit=limit, knee=0.125))
        assert float(soft) == pytest.approx(flow / (1.0 + (flow / limit) ** 16) ** (1 / 16), rel=1e-9, abs=1e-15)
    unlimited = effect("pump_saturation").flow(number(9e-5), local(0.1), values(limit=full, knee=0.5))
    assert float(unlimited) == 9e-5


def test_an_exponent_of_one_is_a_linear_law() -> None:
    law = effect("flow_exponent")
    flows = [
        float(law.flow(local(x).root(number(x)), local(x), values(excess=0.5, reference=0.2))) for x in (0.1, 0.2, 0.4)
    ]
    assert flows[1] == pytest.approx(2.0 * flows[0], rel=1e-9)
    assert flows[2] == pytest.approx(4.0 * flows[0], rel=1e-9)
    assert flows[1] == pytest.approx(math.sqrt(0.2), rel=1e-9), "the reference head keeps its flow"


def test_valves() -> None:
    assert through(effect("valve_dead_zone"), [0.1, 0.6, 1.0], 1.0, values(dead_zone=0.2)) == pytest.approx(
        [0.0, 0.5, 1.0]
    )
    # Three quarters of the head lost outside: half open, flow ratios of 0.5 / sqrt(1/4 + 3/16).
    assert through(effect("valve_authority"), [0.0, 0.5, 1.0], 1.0, values(series=0.75)) == pytest.approx(
        [0.0, 0.5 / (7 / 16) ** 0.5, 1.0]
    )
    assert through(effect("valve_characteristic"), [0.0, 0.5, 1.0], 1.0, values(bend=1.0)) == pytest.approx(
        [0.0, 0.25, 1.0]
    )
    assert through(effect("valve_leak"), [0.0, 0.5, 1.0], 1.0, values(size=0.1)) == pytest.approx([0.1, 0.55, 1.0])


def filled(effects: tuple[PlacedEffect, ...], minutes: float = 10.0, height: float = 1.0) -> Tensor:
    """Levels of three tanks without pipes, 50 cm3/s into T1 and T2 from empty."""
    plant = three_tank((0.0, 0.0, 0.0), height)
    tanks = tuple(replace(t, leak_reference=None) for t in plant.tanks)
    plant = replace(plant, tanks=tanks, pipes=(), effects=effects)
    network = build_network(plant)
    engine = ReferenceEngine(
        network, ParameterSpace(), lay_out(constant_inputs(plant, 60.0 * minutes, 5.0), plant.channels(), 1.0)
    )
    return engine.levels(torch.zeros(0, dtype=torch.float64))[-1]


def test_an_internal_body_takes_up_its_own_volume() -> None:
    body = PlacedEffect("internal_body", "T1", {"area": 40e-4, "bottom": 0.5, "height": 0.6})
    # 30 l in all; 8 l to reach 0.5 m, 7.2 l to 1.1 m beside the body, the rest above it.
    expected = 1.1 + (30e-3 - 8e-3 - 0.6 * 120e-4) / 160e-4
    assert float(filled((body,), height=3.0)[0]) == pytest.approx(expected, abs=1e-4)


def test_a_tapered_tank_holds_its_mean_area_when_full() -> None:
    taper = PlacedEffect("area_taper", "T1", {"taper": 0.8})
    # V(h) = A (h (1 - s/2) + s h^2 / (2 H)); 30 l after 10 min in a tank 3 m tall.
    level = float(filled((taper,), height=3.0)[0])
    assert 160e-4 * (level * 0.6 + 0.8 * level**2 / 6.0) == pytest.approx(30e-3, rel=1e-6)


def crest_height(flow: float) -> float:
    """How high water stands over the whole rim of a round tank of 160 cm2 when `flow` runs over it (Poleni)."""
    crest = 2.0 * math.sqrt(math.pi * 160e-4)
    return (flow / ((2.0 / 3.0) * 0.6 * math.sqrt(2.0 * 9.81) * crest)) ** (2.0 / 3.0)


def test_what_overflows_lands_where_it_should_and_no_volume_is_lost() -> None:
    low_rim = PlacedEffect("overflow", "T1", {"below_rim": 0.5, "crest": 1.0, "to_T3": 0.25})
    levels = filled((low_rim,), minutes=5.0)  # 15 l, of which T1 holds 8
    assert float(levels[0]) == pytest.approx(0.5 + crest_height(50e-6), abs=1e-5)
    spilt = 15e-3 - 160e-4 * float(levels[0])
    assert 160e-4 * float(levels[2]) == pytest.approx(0.25 * spilt, rel=1e-6)


def test_a_draw_ends_when_it_should() -> None:
    draw = PlacedEffect("unmetered_flow", "T1", {"flow": -20e-6, "begin": 61.3, "duration": 100.0})
    assert float(filled((draw,), height=3.0)[0]) == pytest.approx((30e-3 - 2e-3) / 160e-4, rel=1e-9)


def test_an_empty_tank_has_nothing_to_draw_from() -> None:
    draw = PlacedEffect("unmetered_flow", "T1", {"flow": -80e-6, "begin": 0.0, "duration": 1e4})
    assert filled((draw,), height=3.0).tolist() == pytest.approx([0.0, 30e-3 / 160e-4, 0.0])


def test_operating_range_of_a_recording() -> None:
    plant = replace(
        three_tank(), tanks=(*three_tank().tanks, Tank("T4", 0.01, 0.7)), sensors=(Sensor("d1", "T1", "V", -2.0, 9.0),)
    )
    flows = torch.tensor([[1e-5, 0.0], [3e-5, 2e-5], [0.0, 0.0]], dtype=torch.float64)
    recording = blank_recording(plant, flows, torch.arange(3, dtype=torch.float64))
    seen = replace(recording, outputs=torch.tensor([[8.0], [8.4], [math.nan]], dtype=torch.float64), mask=None)
    reach = operating_range_of(seen, plant)
    assert (reach.duration, reach.commands["Q1"]) == (2.0, (0.0, 3e-5))
    assert reach.readings["d1"] == pytest.approx((8.0, 8.4))
    assert reach.levels["T1"] == pytest.approx((0.3, 0.5)), "a sensor that looks down"
    assert reach.levels["T4"] == (0.0, 0.7), "a tank without a sensor"
    assert operating_range_of(recording, plant).readings["d1"] == (7.0, 9.0), "nothing read: from floor to rim"
    assert interior_points((0.0, 4.0), 3) == [1.0, 2.0, 3.0]


def test_a_quantized_reading_is_the_nearest_step() -> None:
    network = build_network(three_tank(), [Placement(effect("sensor_quantization"), "h2", {"step": 0.01})])
    readings = torch.tensor([[0.1234, 0.1234, 0.1234], [0.1234, 0.1266, 0.1234]], dtype=torch.float64)
    assert quantized(readings, network)[:, 1].tolist() == pytest.approx([0.12, 0.13])
    assert torch.equal(quantized(readings, network)[:, ::2], readings[:, ::2])
    coarse = quantized(readings, network, {"h2.sensor_quantization.step": 0.05})
    assert coarse[:, 1].tolist() == pytest.approx([0.10, 0.15])


def test_the_heads_of_a_pipe_lie_between_those_of_its_ends() -> None:
    plant = three_tank()
    reach = operating_range_of(constant_inputs(plant, 10.0), plant)
    for first, second, heads in (
        ((0.4, 0.6), (0.1, 0.3), (0.1, 0.5)),
        ((0.1, 0.3), (0.4, 0.6), (0.1, 0.5)),
        ((0.2, 0.5), (0.4, 0.6), (0.0, 0.4)),
    ):
        assert head_range(plant, "P13", replace(reach, levels={"T1": first, "T3": second})) == pytest.approx(heads)


def test_times_that_may_be_endless_are_bounded_by_the_recording() -> None:
    network = build_network(three_tank(), placements_for(["T1.unmetered_flow.flow", "Q1.pump_lag.time_constant"]))
    space = bounded_by_recording(network.constants, 900.0)
    assert space["T1.unmetered_flow.begin"].high == 900.0
    assert bounded_by_recording(network.constants, 60.0)["T1.unmetered_flow.duration"].high == 600.0, (
        "never below nominal"
    )
    assert space["Q1.pump_lag.time_constant"].high == 60.0


def test_a_tank_whose_walls_are_all_inclined_holds_a_frustum() -> None:
    taper = PlacedEffect("area_taper", "T1", {"taper": 0.8, "reference": 0.0, "power": 2.0})
    level = float(filled((taper,), height=3.0)[0])
    # The width grows by 40 % from floor to rim.
    ratio = 1.0 + 0.4 * level / 3.0
    assert level / 3.0 * 160e-4 * (1.0 + ratio + ratio**2) == pytest.approx(30e-3, rel=1e-6)


def test_a_taper_measured_at_the_floor_grows_from_there() -> None:
    taper = PlacedEffect("area_taper", "T1", {"taper": 0.8, "reference": 0.0})
    level = float(filled((taper,), height=3.0)[0])
    assert 160e-4 * (level + 0.8 * level**2 / 6.0) == pytest.approx(30e-3, rel=1e-6)


def test_a_drift_that_hardly_settles_follows_the_same_law() -> None:
    """The series for slow settling equals (1 - exp(-b t))/b to all digits of the difference of exponentials."""
    settling = torch.tensor([0.5e-7, 0.999e-7, 1.001e-7, -0.999e-7], dtype=torch.float64)
    time = torch.tensor(1000.0, dtype=torch.float64)
    torch.testing.assert_close(elapsed(time, settling), -torch.expm1(-settling * time) / settling, rtol=1e-11, atol=0.0)


@pytest.mark.parametrize(
    ("settling", "expected"),
    [
        (0.0, 1 + 1e-4 * 1000),
        (2e-3, 1 + 1e-4 * (1 - math.exp(-2)) / 2e-3),
        (-4e-4, 1 + 1e-4 * (math.exp(0.4) - 1) / 4e-4),
    ],
)
def test_a_coefficient_drifts_steadily_to_rest_or_away(settling: float, expected: float) -> None:
    there = replace(local(0.5), clock=Clock(number(999.5), number(1.0), number(1.0)))
    drift = effect("coefficient_drift")
    drifted = drift.flow(number(2e-5), there, values(rate=1e-4, settling=settling))
    assert float(drifted) == pytest.approx(2e-5 * expected, rel=1e-12)
    almost = drift.flow(number(2e-5), there, values(rate=1e-4, settling=settling + 1e-12))
    assert float(almost) == pytest.approx(float(drifted), rel=1e-9)


def test_an_oscillation_of_a_sensor_leads_by_its_phase() -> None:
    p = values(amplitude=0.02, period=4.0, phase=1.0)
    read, _ = effect("sensor_oscillation").reading(number(0.5), (), Clock(number(2.0), number(0.5), number(0.5)), p)
    assert float(read) == pytest.approx(0.5 + 0.02 * math.sin(2.0 * math.pi * 2.5 / 4.0 + 1.0), rel=1e-12)


def test_a_tank_loses_what_evaporates_from_its_surface() -> None:
    assert float(effect("evaporation").inflow(local(0.5), values(rate=2e-7))) == pytest.approx(-2e-7 * 0.01, rel=1e-12)


def test_a_pipe_that_has_silted_up_passes_nothing_and_nothing_back() -> None:
    there = replace(local(0.5), clock=Clock(number(999.5), number(1.0), number(1.0)))
    assert float(effect("coefficient_drift").flow(number(2e-5), there, values(rate=-2e-3, settling=0.0))) == 0.0


def test_a_drooping_pump_loses_with_a_power_of_the_level() -> None:
    for droop, expected in ((1.0, 1 - 0.4 * 0.5), (2.0, 1 - 0.4 * 0.25)):
        pumped = effect("pump_back_pressure").flow(number(5e-5), local(0.5), values(loss=0.4, droop=droop))
        assert float(pumped) == pytest.approx(5e-5 * expected, rel=1e-12)
    empty = effect("pump_back_pressure").flow(number(5e-5), local(0.0, 0.0), values(loss=0.4, droop=1.5))
    assert float(empty) == pytest.approx(5e-5, rel=1e-6)


def test_a_flow_between_two_tanks_whose_names_have_hyphens() -> None:
    tanks = (Tank("T-1", 0.01, 0.6, 0.3), Tank("T-2", 0.01, 0.6, 0.2))
    plant = PlantDescription("tags", tanks, (Pipe("P-12", "T-1", "T-2", 1e-4, 0.8),), (), (Sensor("L-1", "T-1"),))
    assert plant.tanks_at("T-1-T-2") == ("T-1", "T-2") and plant.tanks_at("T-1") == ("T-1",)
    assert plant.tanks_at("P-12") == ()
    levels, none = [number(0.3), number(0.2)], Clock(number(0.0), number(1.0), number(1.0))
    rates = []
    for effects in ((), (PlacedEffect("cross_flow", "T-1-T-2", {"size": 0.5}),)):
        network = build_network(replace(plant, effects=effects))
        rates.append(network.rates(levels, [], none, network.bind(ParameterSpace(), network.nominal[:0])))
    more = [float(b - a) for a, b in zip(*rates, strict=True)]
    assert more[0] < -1e-4 and more[1] == pytest.approx(-more[0])
    with pytest.raises(ValueError, match="expected each name once, got 'T-1-T-2' twice"):
        replace(plant, sensors=(Sensor("T-1-T-2", "T-1"),))
