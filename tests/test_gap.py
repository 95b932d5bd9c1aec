"""The gap diagnosis on simulated recordings with known noise, plants and causes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from fdi_torch.config.simulation import reading_noise
from fdi_torch.effects import build_network, placements_for
from fdi_torch.estimate.misfit import EXACT
from fdi_torch.gap.answer import adopted
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.channel_noise import (
    Noise,
    estimate_noise,
    low_frequency_excess,
    quantization_step,
    with_rounding,
)
from fdi_torch.gap.dataset import data_set_of
from fdi_torch.gap.diagnose import Settings, diagnose, recalibrate
from fdi_torch.gap.identifiability import planned_identifiability
from fdi_torch.gap.library import STANDARD, equivalence_class, library_of
from fdi_torch.gap.screening import Pairs
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.constants import leak_pipe
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.experiment import lay_out
from tests.rigs import blank_recording, constant_inputs, three_tank

WHOLE = (slice(None),)
SMALL = ("pump_gain", "pump_lag", "laminar_flow", "leak@T1", "sensor_bias")


def nominal_plant() -> PlantDescription:
    tolerances = {f"{p}.discharge_coefficient": 0.03 for p in ("P13", "P32", "OUT2")}
    return replace(three_tank(), tolerances=tolerances)


def noise(samples: int, ar: float, std: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    fresh = torch.randn(samples, 3, generator=generator, dtype=torch.float64) * std * math.sqrt(1 - ar * ar)
    rows = [fresh[0] / math.sqrt(1 - ar * ar)]
    for row in fresh[1:]:
        rows.append(ar * rows[-1] + row)
    return torch.stack(rows)


def recorded(
    values: dict[str, float],
    seed: int,
    samples: int = 1000,
    std: float = 1e-3,
    ar: float = 0.0,
    steady: bool = False,
    inputs: Tensor | None = None,
    plant: PlantDescription | None = None,
) -> Recording:
    """The three tanks, or another plant, with some parameters changed, under random steps, steady or given inputs, read
    with noise (m)."""
    plant = plant or nominal_plant()
    generator = torch.Generator().manual_seed(seed)
    time = torch.arange(samples, dtype=torch.float64)
    levels = 15e-6 + 60e-6 * torch.rand(samples // 70 + 1, 2, generator=generator, dtype=torch.float64)
    levels = torch.full_like(levels, 50e-6) if steady else levels
    steps = levels.repeat_interleave(70, dim=0)[:samples]
    blank = blank_recording(plant, steps if inputs is None else inputs, time)
    network = build_network(plant, placements_for(values))
    names = [*values, *(n for n in ("P13.discharge_coefficient",) if n not in values)]
    space = ParameterSpace(network.constants[n] for n in names)
    engine = Collocation(network, space, lay_out(blank, plant.channels(), 1.0))
    theta = space.vector(values).unsqueeze(0)
    readings = engine.converge(theta).readings[0]
    return replace(blank, outputs=readings + noise(samples, ar, std, seed + 1), mask=None)  # type: ignore[arg-type]


@pytest.mark.parametrize("ar", [0.0, 0.8])
def test_level_and_correlation_of_noise_are_estimated_despite_a_slow_misfit(ar: float) -> None:
    x = noise(4000, ar, 0.002, 3)
    slow = 0.01 * torch.sin(torch.arange(4000, dtype=torch.float64) / 200.0).unsqueeze(1)
    found = estimate_noise(x + slow, torch.ones_like(x, dtype=torch.bool), WHOLE)
    assert found.std.tolist() == pytest.approx([0.002] * 3, rel=0.15 if ar else 0.04)
    assert found.ar.tolist() == pytest.approx([ar] * 3, abs=0.04)
    assert found.mean_of == 0


def test_a_model_error_that_jumps_between_recordings_is_not_taken_for_correlated_noise() -> None:
    rows = [slice(401 * k, 401 * k + 400) for k in range(4)]
    residual, mask = torch.zeros(4 * 401 - 1, 3, dtype=torch.float64), torch.zeros(4 * 401 - 1, 3, dtype=torch.bool)
    for k, r in enumerate(rows):
        ramp = 0.1 * (-1) ** k * torch.linspace(1.0, 0.0, 400, dtype=torch.float64)
        residual[r], mask[r] = noise(400, 0.0, 0.002, k) + ramp.unsqueeze(1), True
    found = estimate_noise(residual, mask, rows)
    assert found.std.tolist() == pytest.approx([0.002] * 3, rel=0.06)
    assert found.ar.tolist() == [0.0] * 3
    across = estimate_noise(residual, mask, WHOLE)
    assert float(across.ar.min()) > 0.1


@pytest.mark.parametrize("ar", [0.0, 0.8])
def test_the_noise_of_recordings_side_by_side_is_that_of_each(ar: float) -> None:
    """Long ones with a misfit that jumps from one to the next, of which each channel misses another part."""
    lengths, rows = (20000, 20000, 500, 15, 7000), []
    for samples in lengths:
        rows.append(slice(rows[-1].stop + 1 if rows else 0, (rows[-1].stop + 1 if rows else 0) + samples))
    x = noise(rows[-1].stop, ar, 0.002, 3)
    for k, r in enumerate(rows):
        x[r] += 0.3 * (-1) ** k * torch.cos(torch.arange(lengths[k], dtype=torch.float64) / 5000.0).unsqueeze(1)
    mask = torch.rand(x.shape, generator=torch.Generator().manual_seed(2)) > torch.tensor([0.0, 1e-4, 1e-3])
    mask[[r.stop for r in rows[:-1]]] = False
    found = estimate_noise(x, mask, rows=rows)
    assert found.std.tolist() == pytest.approx([0.002] * 3, rel=0.04)
    assert found.ar.tolist() == pytest.approx([ar] * 3, abs=0.02)
    assert found.mean_of == 0


def test_a_recording_without_noise_tells_no_more_than_the_simulation() -> None:
    recording = recorded({"P13.discharge_coefficient": 0.61}, 5, samples=300, std=0.0)
    fitter = recalibrate(data_set_of(nominal_plant(), (), recording, 1.0))[0]
    assert bool((fitter.noise.std >= 0.999 * EXACT * recording.outputs.amax(dim=0)).all())


def test_whitened_noise_is_white_and_of_unit_variance_also_across_masked_samples() -> None:
    x = noise(20000, 0.7, 0.5, 5)
    mask = torch.rand(x.shape, generator=torch.Generator().manual_seed(2)) > 0.2
    ar = torch.full((3,), 0.7, dtype=torch.float64)
    white = Noise(0.5 * torch.sqrt(1 - ar**2), ar).whiten(x, mask)
    assert float((white[~mask]).abs().max()) == 0.0
    assert float(white[mask].var()) == pytest.approx(1.0, abs=0.02)
    assert float((white[1:] * white[:-1])[mask[1:] & mask[:-1]].mean()) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("mean_of", [0, 4])
def test_the_likelihood_of_correlated_noise_with_masked_samples_is_that_of_a_dense_normal_distribution(
    mean_of: int,
) -> None:
    """For AR(1) noise the covariance is a^|s - t| within, and 0 between, runs of valid samples."""
    ar = torch.tensor([0.9, 0.3], dtype=torch.float64)
    own, samples = Noise(torch.tensor([0.5, 2.0], dtype=torch.float64), ar, mean_of), torch.arange(40)
    mask = torch.rand(40, 2, generator=torch.Generator().manual_seed(4)) > 0.4
    basis = own.whiten(torch.eye(40, dtype=torch.float64).unsqueeze(1).expand(40, 2, 40), mask)
    expected = 0.0
    for c in range(2):
        whitening = basis[mask[:, c], c][:, mask[:, c]]
        covariance = torch.linalg.inv(whitening.T @ whitening)
        if not mean_of:
            runs = (~mask[:, c]).cumsum(0)
            together = (runs.unsqueeze(1) == runs)[mask[:, c]][:, mask[:, c]]
            lag = (samples.unsqueeze(1) - samples).abs()[mask[:, c]][:, mask[:, c]]
            torch.testing.assert_close(covariance, own.std[c] ** 2 * torch.where(together, ar[c] ** lag, 0.0))
        expected += float(torch.linalg.slogdet(covariance).logabsdet)
    data = replace(data_set_of(nominal_plant(), (), recorded({}, 3, samples=40), 1.0), mask=mask)
    assert Fitter(data, own).log_det == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("samples", "slow"), [(3, 0.0), (8, 0.0), (8, 0.05)])
def test_a_moving_average_is_detected_and_inverted(samples: int, slow: float) -> None:
    """Taken for AR(1), a mean has several times the slow power that it should."""
    fresh = noise(6000 + samples - 1, 0.0, 0.002, 9)
    mean = torch.stack([fresh[j : j + 6000] for j in range(samples)]).mean(dim=0)
    misfit = slow * torch.sin(torch.arange(6000, dtype=torch.float64) / 200.0).unsqueeze(1)
    mask = torch.ones_like(mean, dtype=torch.bool)
    found = estimate_noise(mean + misfit, mask, WHOLE)
    assert found.mean_of == samples
    assert found.std.tolist() == pytest.approx([0.002 / math.sqrt(samples)] * 3, rel=0.06)
    assert found.lag_one.tolist() == pytest.approx([1.0 - 1.0 / samples] * 3, abs=0.01)
    repeats = 1.0 + 2.0 * sum((1.0 - k / samples) ** 2 for k in range(1, samples))
    assert found.squared_correlations.tolist() == pytest.approx([repeats] * 3, rel=0.02)
    white = found.whiten(mean, mask)
    power = torch.fft.rfft(white, dim=0).abs() ** 2 / len(white)
    assert float(power[1:200].mean()) == pytest.approx(1.0, abs=0.13)  # 600 values of variance 1, and what was undone
    mask[2000:2100, 1] = False
    hidden = found.whiten(mean, mask)
    assert float(hidden[~mask].abs().max()) == 0.0
    assert float(hidden[mask].var()) == pytest.approx(1.0, abs=0.05)


def test_a_constant_offset_is_slow_and_counts_with_all_its_squares() -> None:
    assert low_frequency_excess(torch.full((600, 2), 3.0, dtype=torch.float64)) == pytest.approx(2 * 600 * 3.0**2)


def test_quantized_readings_are_no_moving_average() -> None:
    """What rounding adds has a colour of its own, from which no averaging transmitter follows."""
    fresh = noise(6007, 0.0, 0.002, 9)
    mean = torch.stack([fresh[j : j + 6000] for j in range(8)]).mean(dim=0)
    mask = torch.ones_like(mean, dtype=torch.bool)
    assert estimate_noise(mean, mask, WHOLE).mean_of == 8
    assert estimate_noise(mean, mask, WHOLE, (0.0, 0.0, 0.1)).mean_of == 0


def test_a_quantized_channel_has_a_step_and_a_printed_one_has_none() -> None:
    x = 0.3 + 0.1 * torch.sin(torch.arange(2000, dtype=torch.float64) / 90) + noise(2000, 0.0, 0.001, 1)[:, 0]
    assert quantization_step((x / 0.013).round() * 0.013, 0.001) == pytest.approx(0.013, rel=1e-6)
    assert quantization_step((x * 1e6).round() / 1e6, 0.001) == 0.0
    assert quantization_step(x, 0.001) == 0.0


def test_rounding_that_costs_no_information_is_not_told() -> None:
    """As in a recording that is printed to a tenth of a millimetre, with noise of half a millimetre."""
    x = (1e4 * (0.3 + noise(20000, 0.0, 0.0005, 1)[:, 0])).round() / 1e4
    assert quantization_step(x, 0.0005) == 0.0
    assert quantization_step(x, 0.0002) == pytest.approx(1e-4, rel=1e-6)


def test_rounding_adds_a_uniform_error_to_the_noise_of_the_other_channels() -> None:
    """A step q has the standard deviation q / sqrt(12)."""
    both = Noise(torch.full((2,), 1e-3, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    moving = 0.05 * torch.arange(100, dtype=torch.float64).unsqueeze(1).expand(100, 2)
    told = with_rounding(both, (0.0, 0.012), moving, torch.ones(2, dtype=torch.float64))
    assert told.std.tolist() == pytest.approx([1e-3, math.hypot(1e-3, 0.012 / math.sqrt(12.0))])


@pytest.mark.parametrize("gain", [2.0, -2.0])
def test_the_noise_below_a_rounding_is_that_of_the_other_sensors_in_metres(gain: float) -> None:
    """20 V/m with 20 mV of noise, beside another sensor that is rounded."""
    both = Noise.white(torch.tensor([0.02, 5e-4], dtype=torch.float64))
    moving = 0.05 * torch.arange(100, dtype=torch.float64).unsqueeze(1).expand(100, 2)
    gains = torch.tensor([20.0, gain], dtype=torch.float64)
    told = with_rounding(both, (0.0, 1e-3), moving, gains)
    assert told.std.tolist() == pytest.approx([0.02, math.hypot(2e-3, 1e-3 / math.sqrt(12.0))])


def test_a_pair_gains_nothing_if_one_size_had_to_be_negative() -> None:
    """Columns along (1, 0) and (4, 3) / 5 close all of (2, 1); of (2, -1) only what the first does alone."""
    columns = torch.tensor([[1.0, 0.8], [0.0, 0.6]], dtype=torch.float64)
    for left, together in (([2.0, 1.0], 5.0), ([2.0, -1.0], 0.0)):
        score = columns.T @ torch.tensor(left, dtype=torch.float64)
        assert float(Pairs((), score, columns.T @ columns).gain()[0, 1]) == pytest.approx(together)


def test_a_fault_free_rig_with_constants_within_tolerance_has_no_gap() -> None:
    answer = diagnose(nominal_plant(), recorded({"P13.discharge_coefficient": 0.615}, 11), settings=Settings(SMALL))
    assert answer.verdict == "no_gap" and not answer.causes
    assert answer.p_value > 1e-3


def test_a_known_cause_is_named_with_its_size_and_closes_the_gap() -> None:
    """In correlated noise; in white noise see test_gap_closure."""
    values = {"Q1.pump_lag.time_constant": 12.0, "P32.discharge_coefficient": 0.61}
    recording, holdout = recorded(values, 21, ar=0.8), recorded(values, 22, ar=0.8)
    answer = diagnose(nominal_plant(), recording, holdout, Settings(SMALL))
    assert answer.verdict == "named"
    (cause,) = answer.causes
    assert (cause.effect, cause.location) == ("pump_lag", "Q1")
    amount = cause.parameters["time_constant"]
    assert abs(amount.value - 12.0) < 5 * amount.std < 3.0
    assert answer.closure["closed"] == pytest.approx(1.0, abs=0.03)
    assert answer.closure["augmented"] == pytest.approx(0.1, rel=0.1)  # cm: the noise


def test_a_leak_is_told_with_its_flow_at_the_mean_level() -> None:
    """By Torricelli's law; a cause without a flow of its own, such as a pump gain, has none."""
    plant, settings = nominal_plant(), Settings(("leak@T1", "pump_gain@Q2"), named_only=True)
    recording = recorded({"T1.leak.size": 0.2}, 61, samples=400)
    (cause,) = diagnose(plant, recording, settings=settings).causes
    hole = leak_pipe(plant, "T1")
    speed = math.sqrt(2.0 * plant.gravity * float(recording.outputs[:, 0].mean()))
    assert cause.flow == pytest.approx(0.2 * hole.discharge_coefficient * hole.area * speed, rel=0.05)
    gain = recorded({"Q2.pump_gain.factor": 1.12}, 62, samples=400)
    (cause,) = diagnose(plant, gain, settings=settings).causes
    assert cause.effect == "pump_gain" and cause.flow is None


def test_two_causes_are_named_together() -> None:
    values = {"Q2.pump_gain.factor": 1.12, "h1.sensor_bias.bias": 0.03}
    answer = diagnose(nominal_plant(), recorded(values, 31, samples=500), settings=Settings(SMALL))
    assert answer.verdict == "named"
    assert {(c.effect, c.location) for c in answer.causes} == {("pump_gain", "Q2"), ("sensor_bias", "h1")}


def test_a_cause_that_the_library_lacks_is_unknown_at_its_place() -> None:
    values = {"P13.plugging.size": 0.4, "P13.plugging.onset": 225.0}
    recording = recorded(values, 41, samples=500)
    answer = diagnose(nominal_plant(), recording, settings=Settings((*SMALL, "plugging"), ("plugging",)))
    assert answer.verdict == "unknown"
    assert [(c.effect, c.location) for c in answer.causes] == [("unknown", "P13")]
    assert answer.where[0][0] == "P13"


def test_slow_noise_that_no_effect_explains_is_no_unknown_cause() -> None:
    recording = recorded({"P13.discharge_coefficient": 0.61}, 1, samples=1500)
    slow = replace(recording, outputs=recording.outputs + noise(1500, 0.95, 7e-4, 51))
    answer = diagnose(nominal_plant(), slow, settings=Settings(("pump_delay", "pump_saturation", "sensor_lag")))
    assert answer.p_value > 1e-3
    assert answer.verdict == "no_gap"


def test_equivalent_causes_are_one_hypothesis() -> None:
    """Plugging and openness of a pipe were an ambiguous answer."""
    recording = recorded({"P13.plugging.size": 0.2}, 51, samples=400)
    answer = diagnose(nominal_plant(), recording, settings=Settings(("plugging@P13", "openness@P13")))
    assert answer.verdict == "named" and len(answer.ambiguity_set) == 1


def test_the_answer_follows_the_protocol() -> None:
    recording = recorded({"Q2.pump_gain.factor": 1.12}, 51, samples=400)
    answer = diagnose(nominal_plant(), recording, settings=Settings(("pump_gain",)))
    found, gain = answer.to_dict(), {"effect": "pump_gain", "location": "Q2"}
    assert found["format"] == "fdi_torch.gap/2"
    assert found["ambiguity_set"] == [[gain]] and found["certain"] == [gain]
    assert 0.0 < found["unexamined"] < 0.01 and found["posterior"][0]["probability"] < 1.0
    assert sum(e["probability"] for e in found["posterior"]) + found["unexamined"] == pytest.approx(1.0, abs=1e-3)
    assert set(found["disturbances"]) == {"T1", "T2", "T3"}


def test_the_library_offers_65_effects_at_places_of_the_three_tanks() -> None:
    assert len(library_of(nominal_plant(), STANDARD)) == 65


def test_a_leak_at_the_floor_and_a_plugged_outlet_without_a_valve_are_one_cause() -> None:
    plant, plugged, leak = nominal_plant(), ("plugging", "OUT2"), ("leak", "T2")
    share = ("net_outlet", "OUT2")
    both = {plugged, leak, share}
    assert equivalence_class(leak, plant, {}) == both == equivalence_class(plugged, plant, {})
    assert equivalence_class(plugged, plant, {"OUT2.plugging.size": -0.4}) == both
    assert equivalence_class(leak, plant, {"T2.leak.height": 0.3}) == {leak}
    assert equivalence_class(plugged, plant, {"OUT2.plugging.size": 0.4}) == {plugged, share}
    assert equivalence_class(share, plant, {"OUT2.net_outlet.size": 0.6}) == {plugged, share}
    assert equivalence_class(leak, plant, {"T2.leak.onset": 100.0}) == {plugged, leak}  # a share is constant
    assert equivalence_class(plugged, plant, {"OUT2.plugging.size": 0.4, "OUT2.plugging.onset": 9.0}) == {plugged}
    pipe = ("plugging", "P13")
    assert equivalence_class(pipe, plant, {"P13.plugging.size": -0.4}) == {pipe}
    opened = ("openness", "P13")
    assert equivalence_class(opened, plant, {}) == {opened, pipe} == equivalence_class(pipe, plant, {})
    (outlet,) = (p for p in plant.pipes if p.name == "OUT2")
    with_valve = replace(plant, pipes=tuple(replace(p, valve="v") if p is outlet else p for p in plant.pipes))
    assert equivalence_class(plugged, with_valve, {}) == {plugged, share}
    assert equivalence_class(leak, with_valve, {}) == {leak}
    two_outlets = replace(plant, pipes=(*plant.pipes, replace(outlet, name="OUT4")))
    all_five = both | {("plugging", "OUT4"), ("net_outlet", "OUT4")}
    assert all(equivalence_class(c, two_outlets, {}) == all_five for c in all_five)


def test_a_pair_of_tanks_is_accepted_in_either_order() -> None:
    assert [p.location for p in library_of(nominal_plant(), ("cross_flow@T2-T1",))] == ["T1-T2"]


@pytest.mark.parametrize(
    ("names", "left_out", "message"),
    [
        (("pump_lagg",), (), "the nearest is 'pump_lag'"),
        (("pump_lag@T1",), (), "expected a place of kind pump or transfer, got T1"),
        (("pump_lag",), ("pump_lag",), "expected at least one effect"),
        (("pump_lag@Q9",), (), "library: pump_lag@Q9: expected a place of plant three_tank .*got 'Q9'"),
        (("pump_lag@",), (), "expected a place after the @"),
        (("all", "pump_lag"), (), "expected 'all' by itself"),
        (("pump_lag",), ("leak@T1",), "expected an effect without a place"),
    ],
)
def test_a_wrong_library_raises(names: tuple[str, ...], left_out: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        library_of(nominal_plant(), names, left_out)


def test_a_recording_without_a_sensor_is_refused() -> None:
    recording = recorded({"Q2.pump_gain.factor": 1.1}, 1, samples=100)
    with pytest.raises(ValueError, match="expected a sensor 'h1'"):
        diagnose(nominal_plant(), replace(recording, output_names=("x", "h2", "h3")))


def test_planned_inputs_show_which_effects_are_hidden() -> None:
    library = ("pump_gain", "pump_dead_zone@Q1", "sensor_bias@h2", "sensor_saturation@h1")
    steady = constant_inputs(nominal_plant(), 600.0)
    at_rest = planned_identifiability(nominal_plant(), steady, [1e-3] * 3, library)
    assert ("pump_gain", "Q1") in at_rest.hidden  # three constants with 3 % tolerance take it all
    lively = planned_identifiability(
        nominal_plant(), recorded({"P13.discharge_coefficient": 0.6}, 61), [1e-3] * 3, library
    )
    assert ("pump_gain", "Q1") not in lively.hidden
    assert ("sensor_saturation", "h1") in at_rest.hidden


def test_planned_noise_is_that_of_the_level_whatever_unit_a_sensor_has() -> None:
    plant, library = nominal_plant(), ("pump_gain", "plugging")
    in_milliamperes = replace(
        plant, sensors=tuple(replace(s, unit="A", gain=0.016 / 0.6, offset=0.004) for s in plant.sensors)
    )
    inputs = recorded({"P13.discharge_coefficient": 0.6}, 61, samples=300)
    one, other = (
        planned_identifiability(p, inputs, reading_noise("1 mm", p), library) for p in (plant, in_milliamperes)
    )
    assert other.hidden == one.hidden
    assert other.shown == pytest.approx(one.shown)


def test_named_causes_can_be_adopted() -> None:
    recording = recorded({"Q2.pump_gain.factor": 1.12}, 71, samples=400)
    settings = Settings(("pump_gain@Q2", "sensor_bias@h1"), named_only=True)
    answer = diagnose(nominal_plant(), recording, settings=settings)
    plant = adopted(nominal_plant(), answer)
    (placed,) = plant.effects
    assert placed.effect == "pump_gain" and placed.location == "Q2"
    again = diagnose(plant, recording, settings=Settings(("pump_gain@Q1", "sensor_bias@h1")))
    assert again.verdict == "no_gap"
