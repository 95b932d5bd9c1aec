"""Every finding of the check is reported for a recording with that defect, and not for one without it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from fdi_torch import cli
from fdi_torch.config.plant_file import load_plant
from fdi_torch.gap.preprocess.acquisition import usable
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import RecordingCheck, check_recording
from fdi_torch.recordings.csv_writing import write_csv
from fdi_torch.recordings.input_sampling import inputs_not_held
from tests.rigs import blank_recording
from tests.test_gap_convergence import recorded

PLANT = load_plant("three_tank")


def healthy(samples: int = 400) -> Recording:
    """Smooth levels with a little noise, both commands stepping: nothing to find."""
    time = torch.arange(samples, dtype=torch.float64)
    noise = 1e-3 * torch.randn(samples, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    levels = 0.4 + 0.1 * torch.sin(time / 50)[:, None] + noise
    command = torch.where(time < samples / 2, 50e-6, 60e-6)[:, None].expand(samples, 2).clone()
    return Recording(
        time=time,
        inputs=command,
        outputs=levels,
        input_names=("Q1", "Q2"),
        output_names=("h1", "h2", "h3"),
        input_units=("m^3/s", "m^3/s"),
        output_units=("m", "m", "m"),
    )


def with_h1(values: torch.Tensor) -> Recording:
    outputs = healthy().outputs.clone()
    outputs[:, 0] = values
    return replace(healthy(), outputs=outputs, mask=torch.isfinite(outputs))


def with_q1(values: torch.Tensor) -> Recording:
    inputs = healthy().inputs.clone()
    inputs[:, 0] = values
    return replace(healthy(), inputs=inputs)


def found(check: RecordingCheck, kind: str) -> tuple[str, str]:
    """Channel and text of the one finding, which must be of that kind."""
    assert [finding.kind for finding in check.findings] == [kind]
    return check.findings[0].channel, check.findings[0].text


def test_a_rig_without_pumps_is_checked_with_a_long_recording(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("rig.yaml").write_text("tanks: {A: {area: 1 m^2, height: 1 m}}\nsensors: {h: {tank: A}}\n")
    Path("run.csv").write_text("t_s,h_cm\n" + "".join(f"{k},{50 + k % 7}\n" for k in range(2500)))
    assert cli.main(["check", "--plant", "rig.yaml", "--recording", "run.csv"]) == cli.DONE
    assert "1 tank, 0 pipes, 0 pumps, 1 sensor, 0 constants with" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("pipes", "closed"),
    [
        ("", "A, B"),
        ("pipes: {p: {source: A, target: B, area: 1 cm^2, discharge_coefficient: 0.6}}", "A, B"),
        ("weirs: {w: {source: A, target: outside, crest: 30 cm, width: 2 cm}}", "B"),
        (
            "pipes: {p: {source: B, target: A, area: 1 cm^2, discharge_coefficient: 0.6}, "
            "q: {source: B, target: outside, area: 1 cm^2, discharge_coefficient: 0.6}}",
            "",
        ),
        (
            "pipes: {p: {source: B, target: A, area: 1 cm^2, discharge_coefficient: 0.6, free_fall: true}, "
            "q: {source: B, target: outside, area: 1 cm^2, discharge_coefficient: 0.6}}",
            "A",
        ),
    ],
)
def test_tanks_from_which_nothing_leads_outside_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], pipes: str, closed: str
) -> None:
    path = tmp_path / "rig.yaml"
    tanks = "tanks: {A: {area: 1 m^2, height: 1 m}, B: {area: 1 m^2, height: 1 m}}"
    path.write_text(f"{tanks}\nsensors: {{h: {{tank: A}}}}\n{pipes}\n")
    assert cli.main(["check", "--plant", str(path)]) == cli.DONE
    said = [line for line in capsys.readouterr().out.splitlines() if "no water leaves" in line]
    assert said == [f"- {closed}: no water leaves but over a rim; if there is an outlet, add it under pipes"] * bool(
        closed
    )


def test_too_few_readings_for_a_diagnosis_are_said_before_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for samples in (59, 60):
        path = write_csv(healthy(samples), tmp_path / f"{samples}.csv")
        assert cli.main(["check", "--plant", "three_tank", "--recording", str(path)]) == cli.DONE, "train accepts it"
        said = capsys.readouterr().out
        few = "- h1, h2, h3: 59 readings: fdi gap and fdi refit expect at least 60, of all recordings together"
        assert (few in said) is (samples == 59)
        assert ("until then fdi gap and fdi refit refuse the recording" in said) is (samples == 59)
    cli.main(["check", "--plant", "three_tank", "--recording", str(write_csv(healthy(10), tmp_path / "10.csv"))])
    assert "; units, swapped channels and clocks are examined from 20 samples on" in capsys.readouterr().out


def test_a_sensor_without_any_reading_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_csv(with_h1(torch.full((400,), torch.nan)), tmp_path / "run.csv")
    assert cli.main(["check", "--plant", "three_tank", "--recording", str(path)]) == cli.NOT_EXPLAINED
    said = capsys.readouterr().out
    assert "- h1: no reading in 400 samples: wrong column, or leave sensor h1 out of the plant file" in said
    assert "record longer" not in said and "are missing" not in said
    runs = tmp_path / "runs.yaml"
    runs.write_text("recordings: [{file: run.csv, columns: {h1: {recorded: false}}}]")
    assert cli.main(["check", "--plant", "three_tank", "--recording", str(runs)]) == cli.DONE
    assert "- h1: 0 readings: fdi gap and fdi refit expect at least 60" in capsys.readouterr().out


def test_nothing_is_found_in_a_healthy_recording() -> None:
    check = check_recording(healthy(), PLANT)
    assert check.findings == ()
    assert (check.samples, check.duration, check.interval) == (400, 399.0, 1.0)
    assert [(c.name, c.role) for c in check.channels][:3] == [("Q1", "input"), ("Q2", "input"), ("h1", "output")]


def test_summary_tells_range_resolution_and_what_does_not_count() -> None:
    h1 = (healthy().outputs[:, 0] / 0.01).round() * 0.01
    h1[7] = float("nan")
    summary = check_recording(with_h1(h1).masked([(10.0, 19.0)]), PLANT).channels[2]
    assert (summary.missing, summary.masked) == (1, 10)
    assert summary.resolution == pytest.approx(0.01)
    assert (summary.low, summary.high) == (float(h1.nan_to_num(1).min()), float(h1.nan_to_num(0).max()))


def test_gap_in_the_clock() -> None:
    late = healthy().time + 30 * (healthy().time > 200)
    channel, text = found(check_recording(replace(healthy(), time=late), PLANT), "gap")
    assert (channel, text) == ("t", "1 gap longer than 3 sampling intervals (1 s), the longest of 31 s after 200 s")


@pytest.mark.parametrize("missing", [2, 3])
def test_a_gap_is_longer_than_three_sampling_intervals(missing: int) -> None:
    whole, keep = healthy(), torch.ones(400, dtype=torch.bool)
    keep[100 : 100 + missing] = False
    fields = {name: getattr(whole, name)[keep] for name in ("time", "inputs", "outputs", "mask")}
    kinds = [finding.kind for finding in check_recording(replace(whole, **fields), PLANT).findings]
    assert ("gap" in kinds) is (missing == 3)


def test_jittering_clock() -> None:
    jitter = 0.2 * torch.rand(400, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert (
        "varies by up to" in found(check_recording(replace(healthy(), time=healthy().time + jitter), PLANT), "clock")[1]
    )


def test_unknown_command() -> None:
    q1 = healthy().inputs[:, 0].clone()
    q1[100:150] = float("nan")
    assert found(check_recording(with_q1(q1), PLANT), "unknown") == (
        "Q1",
        "unknown from 100 s to 149 s (50 samples): the recording is cut there",
    )


def test_missing_readings() -> None:
    h1 = healthy().outputs[:, 0].clone()
    h1[::10] = float("nan")
    assert (
        found(check_recording(with_h1(h1), PLANT), "missing")[1] == "40 of 400 readings are missing: they do not count"
    )


def test_inputs_that_never_change() -> None:
    still = healthy()
    held = replace(still, inputs=still.inputs[:1].expand_as(still.inputs).clone())
    channels, text = found(check_recording(held, PLANT), "constant input")
    assert channels == "Q1, Q2" and "no change throughout" in text
    one = held.inputs.clone()
    one[200:, 0] *= 2.0
    assert not any(f.kind == "constant input" for f in check_recording(replace(held, inputs=one), PLANT).findings)


def test_constant_channel() -> None:
    constant = check_recording(with_h1(torch.full((400,), 0.4, dtype=torch.float64)), PLANT)
    assert found(constant, "constant")[1] == "constant at 40 cm: its correlation with anything is undefined"


def test_clipped_channel() -> None:
    clipped = check_recording(with_h1(healthy().outputs[:, 0].clamp(max=0.49)), PLANT)
    assert "clipped" in {finding.kind for finding in clipped.findings}
    assert "the highest value 49 cm was read" in clipped.findings[0].text


def test_an_end_is_compared_with_its_neighbour() -> None:
    """The readings next to the highest one are rare; how often low ones were read does not matter."""
    h1 = torch.cat([torch.full((40,), 0.2), torch.full((30,), 0.21), torch.tensor([0.3]), torch.full((20,), 0.4)])
    run = healthy(len(h1))
    clipped = check_recording(replace(run, outputs=torch.stack([h1.double(), *run.outputs.T[1:]], dim=-1)), PLANT)
    text = "h1: the highest value 40 cm was read 20 times: clipped there, or at rest"
    assert [f"{f.channel}: {f.text}" for f in clipped.findings if f.kind == "clipped"] == [text]


def test_frozen_channel() -> None:
    h1 = healthy().outputs[:, 0].clone()
    h1[100:160] = h1[100]
    assert found(check_recording(with_h1(h1), PLANT), "frozen")[1].startswith(
        "did not change for 60 samples, from 100 s to 159 s"
    )


def test_coarsely_rounded_channel() -> None:
    rounded = check_recording(with_h1((healthy().outputs[:, 0] / 0.02).round() * 0.02), PLANT)
    assert found(rounded, "quantised")[1].startswith("moves in steps of 2 cm and stays on one for")


def test_level_above_the_rim_and_below_the_floor() -> None:
    assert (
        "lie above the rim of T1" in found(check_recording(with_h1(healthy().outputs[:, 0] * 2.2), PLANT), "range")[1]
    )
    assert (
        "lie below the floor of T1" in found(check_recording(with_h1(healthy().outputs[:, 0] - 0.4), PLANT), "range")[1]
    )


def test_level_at_the_rim_is_told_with_its_times() -> None:
    levels = healthy().outputs[:, 0].clone()
    levels[100:140] = 1.0 + 1e-3 * torch.randn(40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    channel, text = found(check_recording(with_h1(levels), PLANT), "rim")
    assert channel == "h1"
    assert (
        text == "within 2 % of the rim of T1 (100 cm) in 40 samples between 100 s and 139 s: water may overflow there"
    )
    levels[100:140] -= 0.05
    assert not [f for f in check_recording(with_h1(levels), PLANT).findings if f.kind == "rim"]


@pytest.mark.parametrize("factor", [100.0, 0.01])
def test_level_in_the_wrong_unit(factor: float) -> None:
    assert "a wrong unit" in found(check_recording(with_h1(healthy().outputs[:, 0] * factor), PLANT), "unit")[1]


def test_commands_beyond_what_the_pump_can_do() -> None:
    command = healthy().inputs[:, 0]
    assert (
        "asks for up to 120 cm^3/s of Q1, which delivers 90"
        in found(check_recording(with_q1(2 * command), PLANT), "range")[1]
    )
    assert "asks for a negative flow of Q1" in found(check_recording(with_q1(-command), PLANT), "range")[1]
    assert "is its unit right?" in found(check_recording(with_q1(1e3 * command), PLANT), "unit")[1]


def test_valve_in_percent_taken_for_a_share() -> None:
    rig = load_plant("dts200")
    samples = healthy()
    inputs = torch.zeros(400, 7, dtype=torch.float64)
    inputs[:, :2] = samples.inputs
    inputs[:, 2] = 60.0
    recording = replace(
        samples,
        inputs=inputs,
        input_names=rig.channels(),
        input_units=tuple(rig.channel_units().values()),
        output_names=tuple(sensor.column for sensor in rig.sensors),
    )
    assert found(check_recording(recording, rig), "unit") == (
        "vLM",
        "opens from 6000 % to 6000 %, where 100 % is fully open: is its unit right (pct)?",
    )


@pytest.mark.data
def test_what_is_odd_about_a_real_rig_is_found(real_data: Path) -> None:
    """The tanks are empty for long: the sensors rest at their lowest value, R's 2 cm below its zero."""
    from fdi_torch.config.loaded_recordings import read_recording
    from fdi_torch.config.recording_config import RecordingConfig

    rig = load_plant("dts200")
    file = RecordingConfig(file=str(real_data / "dts200" / "exp5_pump_staircase_drain__2194.csv"))
    kinds = {(f.kind, f.channel) for f in check_recording(read_recording(file, rig), rig).findings}
    assert {("unknown", "qL_cmd"), ("clipped", "h2_R"), ("frozen", "h1_L"), ("range", "h2_R")} <= kinds


def test_readings_logged_on_change_are_told() -> None:
    """A level with a little noise, written where it has moved by 2 mm, or a minute has gone by."""
    whole = healthy(4000)
    values, time = whole.outputs[:, 0] + 0.1 * torch.sin(whole.time / 300), whole.time
    kept = [0]
    for k in range(1, len(time)):
        if abs(float(values[k] - values[kept[-1]])) >= 2e-2 or float(time[k] - time[kept[-1]]) >= 60.0:
            kept.append(k)
    outputs = torch.full_like(whole.outputs, torch.nan)
    outputs[kept, 0] = values[kept]
    outputs[:, 1:] = whole.outputs[:, 1:]
    check = check_recording(replace(whole, outputs=outputs, mask=torch.isfinite(outputs)), PLANT)
    [finding] = [f for f in check.findings if f.kind == "on change"]
    assert finding.channel == "h1"
    assert finding.values["step"] == pytest.approx(2e-2, rel=0.1)


def test_a_jump_by_an_hour_asks_for_the_zone() -> None:
    time = torch.where(torch.arange(400) < 200, torch.arange(400), torch.arange(400) + 3600).double()
    check = check_recording(replace(healthy(), time=time), PLANT)
    assert [f.kind for f in check.findings] == ["clock", "gap"]
    assert "say in which zone, as in columns: {t: {zone: Europe/Berlin}}" in check.findings[0].text


def held_at_random(hold: float, interval: float, samples: int, seed: int, levels: int = 0) -> torch.Tensor:
    """A command that takes a new value at the end of each hold (s), sampled every `interval` s; levels: 0 for any."""
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(int(samples * interval / hold) + 2, generator=generator, dtype=torch.float64)
    values = (draws * levels).floor() / levels if levels else draws
    clock = interval * torch.arange(samples, dtype=torch.float64) + float(torch.rand(1, generator=generator)) * hold
    return 1e-5 + 8e-5 * values[(clock / hold).long()]


def undersampled(command: torch.Tensor) -> bool:
    recording = with_q1(command)
    return "undersampled" in {finding.kind for finding in check_recording(recording, PLANT).findings}


@pytest.mark.parametrize("levels", [0, 2, 5])
@pytest.mark.parametrize("seed", range(10))
def test_a_command_that_moves_faster_than_its_samples(levels: int, seed: int) -> None:
    """Every 1 and 2 s, sampled every 3 s; and the same commands sampled ten times as fast."""
    for hold in (1.0, 2.0):
        assert undersampled(held_at_random(hold, 3.0, 400, seed, levels))
        assert not undersampled(held_at_random(hold, 0.3, 400, seed, levels))


def of_held_commands(hold: float, seed: int, faults: dict[str, float]) -> Recording:
    """Simulated levels under both commands at random, each held for `hold` seconds; 400 samples, one every 3 s."""
    time = 0.1 * torch.arange(12_000, dtype=torch.float64)
    commands = torch.stack([held_at_random(hold, 0.1, len(time), 2 * seed + i) for i in range(2)], dim=1)
    if hold == 3.0:  # new values at the samples, as a computer that controls and logs gives them
        commands = commands[::30].repeat_interleave(30, dim=0)
    whole = recorded(PLANT, blank_recording(PLANT, commands, time), faults, seed)
    return replace(whole, time=time[::30], inputs=commands[::30], outputs=whole.outputs[::30], mask=None)


@pytest.mark.parametrize("hold", [1.0, 2.0, 2.9])
def test_a_command_that_changes_between_its_samples_is_refused(hold: float) -> None:
    """The unknown flow would be taken for effects of the pumps."""
    recording = of_held_commands(hold, 1, {})
    with pytest.raises(
        ValueError, match=r"Q1.*the flow between samples, one every 3 s, is unknown.*log commands faster"
    ):
        usable(PLANT, recording)
    assert usable(PLANT, replace(recording, trusted=True)).fault is None


@pytest.mark.parametrize(
    "faults", [{}, {"Q1.pump_gain.factor": 0.7}, {"Q1.pump_lag.time_constant": 5.0}, {"Q1.pump_delay.delay": 4.0}]
)
def test_a_command_that_is_held_from_sample_to_sample_is_accepted(faults: dict[str, float]) -> None:
    for seed in range(3):
        recording = of_held_commands(3.0, seed, faults)
        assert [f.kind for f in check_recording(recording, PLANT).findings].count("undersampled") == 2
        assert inputs_not_held(recording, PLANT) == []


def test_a_constant_level_says_nothing_of_how_a_command_is_held() -> None:
    recording = with_q1(held_at_random(1.0, 3.0, 400, 0))
    still = replace(recording, inputs=recording.inputs.double(), outputs=torch.full_like(recording.outputs, 0.5))
    assert inputs_not_held(still, PLANT) == []


def test_how_fast_a_command_moves_is_said() -> None:
    channel, text = found(check_recording(with_q1(held_at_random(1.0, 3.0, 400, 0)), PLANT), "undersampled")
    assert channel == "Q1" and "moves about as fast as it is sampled: successive samples correlate by" in text


def test_a_sine_is_known_from_six_samples_a_period_on() -> None:
    time = torch.arange(400, dtype=torch.float64)
    for period, is_fast in ((2.5, True), (4.0, True), (12.0, False), (100.0, False)):
        assert undersampled(5e-5 + 4e-5 * torch.sin(2 * torch.pi * time / period + 0.3)) is is_fast


def test_commands_that_rarely_move_or_of_which_little_is_known_are_not_called_fast() -> None:
    still = torch.full((400,), 5e-5, dtype=torch.float64)
    few = still.clone()
    few[5:] = torch.nan
    few[1] = 6e-5
    assert not undersampled(still) and not undersampled(few)
    assert not undersampled(held_at_random(100.0, 1.0, 400, 0))
    assert not undersampled(5e-5 + 0.1 * held_at_random(1.0, 3.0, 400, 0)), "too little to show in the readings"
