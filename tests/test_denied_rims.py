"""Readings above a tank's rim: the plant file or the sensor is wrong, and no cause may be named because of it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import fdi_torch
from fdi_torch import Pipe, PlacedEffect, Plant, Pump, Recording, Sensor, Tank
from fdi_torch.cli import main
from fdi_torch.recordings.plant_limits import denied_rims, with_rims_unknown

RIG = Plant(
    tanks=[Tank("A", area="200 cm^2", height="60 cm")],
    pipes=[Pipe("drain", "A", "outside", area="0.5 cm^2", discharge_coefficient=0.6)],
    pumps=[Pump("Q", "A", max_flow="9 l/min")],
    sensors=[Sensor("h", "A")],
    tolerances={"*.discharge_coefficient": "1 %"},
    name="one tank",
)
LOW = replace(RIG, tanks=(Tank("A", area="200 cm^2", height="34 cm"),))
TOLD = (
    r"h: \d+ readings lie above the rim of A, up to 36\.\d+ cm of 34 cm, which neither noise nor tolerances explain; "
    r"correct tanks.A.height, or gain and offset of h if it reads too high"
)


def recorded(rig: Plant = RIG, peak: str = "6 l/min", **faults: Any) -> Recording:
    steps = {"Q": {"steps": [["0 s", "4 l/min"], ["200 s", peak], ["500 s", "3 l/min"]]}}
    noise = {"std": {"h": "1 mm"}}
    return fdi_torch.simulate(rig, inputs=steps, duration="800 s", noise=noise, faults=faults, seed=1)


def test_the_true_cause_is_found_although_the_rim_in_the_plant_file_is_wrong(tmp_path: Path) -> None:
    """A leak raises no level above 34 cm; a rim there had been explained by a drifting sensor, with certainty."""
    leaking = recorded(**{"A.leak": 0.2})
    library = ("leak", "sensor_drift", "sensor_gain", "plugging")
    found, right = (fdi_torch.gap(plant, leaking, out=tmp_path, library=library) for plant in (LOW, RIG))
    assert found.headline == right.headline and "leak at A" in found.headline
    assert re.match(TOLD, found.answer.remarks[0]) and not any("rim" in remark for remark in right.answer.remarks)
    assert "plant.tanks.A.height (gap: 34 cm; gap_2: 60 cm)" in fdi_torch.compare([found.log, right.log]).headline
    assert found.adopted().tanks == LOW.tanks, "the plant file is the user's to correct"


def test_gap_and_predict_say_it_before_what_to_do_next(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    leaking = recorded(**{"A.leak": 0.2})
    (here / "low.yaml").write_text(fdi_torch.dump_plant(LOW))
    fdi_torch.write_csv(leaking, here / "run.csv")
    for command, code in (("gap", 0), ("predict", 4)):
        assert main([command, "--plant", "low.yaml", "--recording", "run.csv"]) == code
        told = capsys.readouterr().out.splitlines()
        assert re.match(f"- {TOLD}", told[1]), told
        assert "next: " in " ".join(told[2:5]) and "no longer take the gap for a fault" not in " ".join(told)
    assert main(["predict", "--plant", "low.yaml", "--recording", "run.csv", "--json"]) == 4
    assert re.match(TOLD, json.loads(capsys.readouterr().out)["doubts"][0])
    run = fdi_torch.predict(LOW, leaking)
    assert re.search(TOLD, run.headline) and "rim" not in fdi_torch.predict(RIG, leaking).headline
    assert "relied on" not in fdi_torch.predict(LOW, replace(leaking, trusted=True)).headline


def test_train_refit_and_monitor_refuse_until_the_plant_file_is_right(tmp_path: Path) -> None:
    leaking, output = recorded(**{"A.leak": 0.2}), {"output": {"folder": str(tmp_path)}}
    train: dict[str, Any] = {"recordings": [leaking], "estimate": {"parameters": ["A.leak"]}}
    monitor: dict[str, Any] = {"recording": leaking, "fault_free": ["0 s", "600 s"]}
    for job, keys in ((fdi_torch.train, train), (fdi_torch.monitor, monitor)):
        with pytest.raises(ValueError, match=TOLD):
            job({"plant": LOW, **keys, **output})
    with pytest.raises(ValueError, match=TOLD):
        fdi_torch.refit(LOW, leaking)
    trusted = replace(leaking, trusted=True)
    assert fdi_torch.train({"plant": LOW, **train, "recordings": [trusted], **output}).estimate.status


def test_water_that_overflows_noise_spikes_and_tolerances_deny_no_rim() -> None:
    overflowing = recorded(LOW, "9 l/min")
    assert float(overflowing.outputs.max()) > 0.34 and denied_rims(LOW, overflowing) == []
    noisy = torch.randn(5000, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    full = replace(
        overflowing,
        time=torch.arange(5000, dtype=torch.float64),
        inputs=torch.full((5000, 1), 1e-4, dtype=torch.float64),
        outputs=0.34 * 1.02 + 0.02 * noisy,
        mask=torch.ones(5000, 1, dtype=torch.bool),
    )
    assert int((full.outputs > 0.36).sum()) > 1000 and denied_rims(LOW, full) == []
    spiked = replace(overflowing, outputs=overflowing.outputs.clone())
    spiked.outputs[100:103] = 0.9
    assert denied_rims(LOW, spiked) == []
    above = recorded(**{"A.leak": 0.2})
    assert [each.tank.name for each in denied_rims(LOW, above)] == ["A"]
    for tolerances in ({"h.gain": 0.2}, {"h.offset": 0.06}, {"A.height": 0.2}):
        assert denied_rims(replace(LOW, tolerances=tolerances), above) == []
    known = replace(LOW, effects=(PlacedEffect("sensor_gain", "h", {"factor": 1.2}),))
    assert denied_rims(known, above) == []


def test_a_rim_that_is_unknown_is_beyond_all_levels_and_has_no_tolerance() -> None:
    plant = replace(LOW, tolerances={"A.height": 0.001, "drain.discharge_coefficient": 0.01})
    unknown = with_rims_unknown(plant, [recorded()])
    assert unknown.tanks[0].height > 0.6 and unknown.tolerances == {"drain.discharge_coefficient": 0.01}
    assert with_rims_unknown(plant, [replace(recorded(), trusted=True)]) == plant
