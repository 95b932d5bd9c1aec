"""A slower or larger rig, or one in other units, gets the same diagnosis in its own units.

The factors are not powers of two or ten, so that nothing but rounding may differ; a constant in metres, seconds or
m^3/s that is not the plant's own would show.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from rigs import factor, rescaled

from fdi_torch.config.loaded_recordings import named_recordings
from fdi_torch.config.plant_file import load_plant
from fdi_torch.gap.answer import Answer
from fdi_torch.gap.diagnose import Settings, diagnose
from fdi_torch.gap.localization.regressors import lags_and_decays, rate_limits
from fdi_torch.recording import Recording
from tests.test_gap import SMALL, nominal_plant, recorded

SLOWER, WIDER = 20.0, 1000.0
FLOWS = WIDER / SLOWER  # A dh/dt = q
LAG, LEAK = "Q1.pump_lag.time_constant", "T3.leak.size"
SIZES = {LAG: 15.0, LEAK: 0.1}


def told(recording: Recording, metres: float, seconds: float) -> Recording:
    """What a rig of other lengths and at another pace would have recorded."""
    inputs, outputs = recording.inputs * metres**3 / seconds, recording.outputs * metres
    return replace(recording, time=recording.time * seconds, inputs=inputs, outputs=outputs)


@cache
def answer(cause: str, left_out: tuple[str, ...], metres: float, seconds: float) -> Answer:
    """With a hold-out where something is left out of the library."""
    seeds = (5, 42) if left_out else (5,)
    library = ("leak", "pump_gain", "sensor_bias") if cause == LEAK else (*SMALL, "leak")
    runs = [told(recorded({cause: SIZES[cause]}, seed, samples=300), metres, seconds) for seed in seeds]
    return diagnose(rescaled(nominal_plant(), metres, seconds), *runs, settings=Settings(library, left_out))


def expect_same(found: Answer, usual: Answer, metres: float, seconds: float) -> None:
    """Equal to within what iterations leave: a millionth of probabilities, standard errors, and sizes in these."""
    assert found.verdict == usual.verdict
    assert dict(found.where) == pytest.approx(dict(usual.where), rel=1e-6, abs=1e-9)
    assert [(c.effect, c.location) for c in found.causes] == [(c.effect, c.location) for c in usual.causes]
    for here, there in zip(usual.causes, found.causes, strict=True):
        for name, amount in here.parameters.items():
            scale = factor(amount.unit, metres, seconds)
            assert there.parameters[name].value / scale == pytest.approx(amount.value, abs=1e-6 * amount.std)
            assert there.parameters[name].std / scale == pytest.approx(amount.std, rel=1e-6)


@pytest.mark.parametrize(
    ("cause", "left_out", "metres", "seconds"), [(LEAK, (), 3.7, 0.23), (LAG, ("pump_lag",), 0.05, 60.0)]
)
def test_a_rig_of_another_size_and_pace_has_the_same_numbers(
    cause: str, left_out: tuple[str, ...], metres: float, seconds: float
) -> None:
    usual = answer(cause, left_out, 1.0, 1.0)
    assert usual.verdict == ("unknown" if left_out else "named")
    found = answer(cause, left_out, metres, seconds)
    expect_same(found, usual, metres, seconds)
    for model in ("nominal", "noise_floor", "recalibrated", "ceiling") if left_out else ():
        assert found.closure[model] / metres == pytest.approx(usual.closure[model], rel=1e-6), model


def test_a_wider_and_slower_rig_has_the_same_numbers() -> None:
    """Cross-sections may change apart from lengths: A dh/dt = q and q = C sqrt(h) keep their form."""
    plant, run = nominal_plant(), recorded({LAG: SIZES[LAG]}, 5, samples=300)
    wide = replace(
        plant,
        tanks=tuple(replace(t, area=WIDER * t.area) for t in plant.tanks),
        pipes=tuple(replace(p, area=FLOWS * p.area) for p in plant.pipes),
        pumps=tuple(replace(p, max_flow=FLOWS * p.max_flow) for p in plant.pumps),
    )
    slow = replace(run, time=SLOWER * run.time, inputs=FLOWS * run.inputs)
    found = diagnose(wide, slow, settings=Settings((*SMALL, "leak")))
    expect_same(found, answer(LAG, (), 1.0, 1.0), 1.0, SLOWER)


def test_time_constants_of_regressors_scale_with_the_plant() -> None:
    x = torch.rand(50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    step, ends = torch.full_like(x, 2.0), (0.0, 1.0)
    for slow, fast in zip(lags_and_decays(x, 10.0 * step, 10.0), lags_and_decays(x, step, 1.0), strict=True):
        assert slow == pytest.approx(fast, abs=1e-12)
    for slow, fast in zip(rate_limits(x, 10.0 * step, ends, 10.0), rate_limits(x, step, ends, 1.0), strict=True):
        assert slow == pytest.approx(fast, abs=1e-12)


SAME_TANKS = """
name: three_tank
tanks: {T1: {area: 1.6 dm^2, height: 1000 mm, leak_reference: P13}, T2: {area: 24.80005 in^2, height: 1 m,
    leak_reference: OUT2}, T3: {area: 0.016 m^2, height: 39.370079 in, leak_reference: P32}}
pipes:
  P13: {source: T1, target: T3, area: 60 mm^2, discharge_coefficient: 60 %}
  P32: {source: T3, target: T2, area: 0.6 cm^2, discharge_coefficient: 0.6}
  OUT2: {source: T2, target: outside, area: 6e-5 m^2, discharge_coefficient: 0.6}
pumps: {Q1: {target: T1, max_flow: 5.4 l/min}, Q2: {target: T2, max_flow: 0.324 m^3/h}}
sensors: {h1: {tank: T1}, h2: {tank: T2}, h3: {tank: T3}}
tolerances: {"*.discharge_coefficient": 3 %}
"""


def test_a_rig_in_other_units_has_the_same_verdict_and_numbers(tmp_path: Path) -> None:
    """Minutes, litres an hour, inches and millimetres, by the headers, beside SI."""
    bench, usual = recorded({LAG: SIZES[LAG]}, 5, samples=300), answer(LAG, (), 1.0, 1.0)
    (tmp_path / "plant.yaml").write_text(SAME_TANKS)
    units = {"t [min]": 1 / 60, "Q1 (l/h)": 3.6e6, "Q2_l/min": 6e4, "h1 [mm]": 1e3, "h2 [in]": 1 / 0.0254, "h3_cm": 1e2}
    table = torch.cat([bench.time.unsqueeze(1), bench.inputs, bench.outputs], dim=1)
    rows = (table * torch.tensor(list(units.values()), dtype=table.dtype)).tolist()
    lines = [",".join(units), *(",".join(map(repr, row)) for row in rows)]
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n")
    plant = load_plant(tmp_path / "plant.yaml")
    (run,) = named_recordings(str(tmp_path / "run.csv"), plant, tmp_path)
    found = diagnose(plant, run, settings=Settings((*SMALL, "leak")))
    assert found.verdict == usual.verdict == "named"
    assert dict(found.where) == pytest.approx(dict(usual.where), abs=0.005)
    (there,), (here,) = found.causes, usual.causes
    assert (there.effect, there.location) == (here.effect, here.location)
    amount, expected = there.parameters["time_constant"], here.parameters["time_constant"]
    assert amount.value == pytest.approx(expected.value, abs=0.02 * expected.std)
    assert amount.std == pytest.approx(expected.std, rel=0.01)
