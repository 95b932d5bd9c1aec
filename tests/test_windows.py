"""Faults window by window: a fault that comes and goes is there when it was."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fdi_torch.config.plant_file import build_plant
from fdi_torch.config.problems import ConfigError, Source
from fdi_torch.config.run_file import Run, build_run
from fdi_torch.estimate.windows import Window, WindowFault, cut_up, noise_of, state_of, stretches_of
from fdi_torch.jobs.train import train
from fdi_torch.jobs.windowed_fit import fit_windows
from fdi_torch.recording import Recording


def window(start: float, state: str, size: float = 0.5) -> Window:
    return Window(start, start + 10.0, (WindowFault("T1.leak.size", size, 0.1, state, 1e-6),), 1.0)  # type: ignore[arg-type]


def test_neighbouring_windows_with_the_fault_are_one_stretch() -> None:
    states = ["absent", "present", "present", "cannot tell", "present"]
    found = stretches_of([window(10.0 * k, state) for k, state in enumerate(states)])
    assert [(s.start, s.stop) for s in found] == [(10.0, 30.0), (40.0, 50.0)]
    assert found[0].size == pytest.approx(0.5) and found[0].std == pytest.approx(0.1 / 2**0.5)


def test_windows_that_scatter_by_more_than_their_errors_have_a_larger_error() -> None:
    """Two sizes of equal flow, 0.4 and 0.8 +- 0.1: sqrt((0.1^2 + 0.2^2) / 2) for their mean."""
    (found,) = stretches_of([window(0.0, "present", 0.4), window(10.0, "present", 0.8)])
    assert (found.size, found.std) == (pytest.approx(0.6), pytest.approx((0.05 / 2) ** 0.5))


def test_windows_at_the_end_of_the_range_have_no_say_in_the_size() -> None:
    beyond = Window(10.0, 20.0, (WindowFault("T1.leak.size", 1.0, float("inf"), "present", 1e-6),), 1.0)
    (found,) = stretches_of([window(0.0, "present"), beyond])
    assert (found.start, found.stop, found.size, found.std) == (0.0, 20.0, pytest.approx(0.5), pytest.approx(0.1))
    (alone,) = stretches_of([beyond])
    assert alone.size == 1.0 and alone.std == float("inf")


def test_windows_that_are_apart_are_two_stretches() -> None:
    assert len(stretches_of([window(0.0, "present"), window(20.0, "present")])) == 2


def test_windows_of_another_recording_go_on_with_nothing() -> None:
    first, second = window(10.0, "present"), window(0.0, "present")
    assert [(s.start, s.stop) for s in stretches_of([first, second])] == [(10.0, 20.0), (0.0, 10.0)]


def test_a_size_that_its_error_covers_is_absent_and_one_that_nothing_tells_is_unknown() -> None:
    assert state_of(0.2, 0.01, 1.0) == "present"
    assert state_of(0.2, 0.12, 1.0) == "absent"
    assert [state_of(size, 0.1, 1.0) for size in (0.19, 0.2)] == ["absent", "present"], "1.96 standard errors"
    assert state_of(0.01, 0.001, 1.0) == "absent"
    assert state_of(0.2, 0.3, 1.0) == "cannot tell"


def test_windows_lie_side_by_side_and_share_a_sample() -> None:
    time = torch.arange(101, dtype=torch.float64)
    blank = torch.zeros(101, 1, dtype=torch.float64)
    cuts = cut_up(Recording(time, blank, blank, ("q",), ("h",), ("m^3/s",), ("m",)), 30.0)
    assert [(float(c.time[0]), float(c.time[-1])) for c in cuts] == [(0.0, 30.0), (30.0, 60.0), (60.0, 90.0)]


def leaking(folder: Path, duration: str, step: str) -> Run:
    """A leak from 200 s on, windows of 100 s."""
    simulated = {
        "plant": "three_tank",
        "simulate": {
            "inputs": {"Q1": "50 cm^3/s", "Q2": "40 cm^3/s"},
            "duration": duration,
            "faults": {"T1.leak": 0.3, "T1.leak.onset": "200 s"},
            "noise": {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}},
            "start_levels": {"T1": "30 cm", "T2": "15 cm", "T3": "20 cm"},
        },
        "estimate": {
            "parameters": ["T1.leak", "T3.leak"],
            "calibrate": [],
            "windows": "100 s",
            "step": {"refine": step},
        },
        "output": {"folder": str(folder)},
    }
    return build_run(simulated, folder, Source("windows.yaml"))


def test_a_fit_of_whole_recordings_refuses_windows_instead_of_ignoring_them(tmp_path: Path) -> None:
    keys = {"plant": "three_tank", "simulate": {"duration": "100 s"}, "estimate": {"windows": "50 s"}}
    with pytest.raises(ConfigError, match="windows: expected none, got 50 s; fdi train fits windows"):
        train(build_run(keys, tmp_path, Source("train")))


def test_the_step_is_the_one_asked_for(tmp_path: Path) -> None:
    assert fit_windows(leaking(tmp_path, "300 s", "0.7 s")).step == 0.7


def test_a_leak_that_opens_halfway_is_in_the_windows_after_it(tmp_path: Path) -> None:
    found = fit_windows(leaking(tmp_path, "400 s", "auto"))
    assert 0.1 <= found.step <= 5.0  # no longer than a twentieth of a window
    assert [[f.state for f in w.faults] for w in found.windows] == [["absent"] * 2] * 2 + [["present", "absent"]] * 2
    (leak,) = found.stretches
    assert (leak.start, leak.stop) == (200.0, 400.0)
    assert abs(leak.size - 0.3) < 4.0 * leak.std < 0.1
    assert leak.flow is not None and leak.flow > 0.0
    assert found.log.is_file()


def test_levels_at_rest_do_not_tell_four_faults_apart(tmp_path: Path) -> None:
    """Three levels at rest are three equations: a leak of T1 and wider pipes explain them as well as no fault."""
    rest = {
        "plant": "three_tank",
        "seed": 2,  # with this noise the best size of the leak is 0, the end of its range
        "simulate": {
            "inputs": {"Q1": "50 cm^3/s", "Q2": "40 cm^3/s"},
            "duration": "400 s",
            "noise": {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}},
            "start_levels": {"T1": "47.74 cm", "T2": "29.58 cm", "T3": "38.48 cm"},
        },
        "estimate": {
            "parameters": ["T1.leak", "P13.plugging", "P32.plugging", "OUT2.plugging"],
            "calibrate": [],
            "windows": "400 s",
        },
        "output": {"folder": str(tmp_path)},
    }
    found = fit_windows(build_run(rest, tmp_path, Source("rest.yaml")))
    (window,) = found.windows
    assert window.faults[0].size == 0.0 and all(f.std > 0.08 for f in window.faults) and not found.stretches


def test_a_sensor_without_noise_counts_as_off_by_a_share_of_its_span_in_whatever_unit() -> None:
    """The same still levels read in metres and in volts (10 V over 0.5 m): the noise scales with the reading."""
    tank = {"tanks": {"T": {"area": "100 cm^2", "height": "50 cm"}}, "sensors": {"h": {"tank": "T"}}}
    volts = tank | {"sensors": {"h": {"tank": "T", "gain": "0.2 V/cm"}}}
    time = torch.arange(20, dtype=torch.float64)
    still = torch.full((20, 1), 0.3, dtype=torch.float64)
    found = []
    for plant, reading, unit in ((tank, still, "m"), (volts, 20.0 * still, "V")):
        recording = Recording(time, torch.zeros(20, 0, dtype=torch.float64), reading, (), ("h",), (), (unit,))
        found.append(float(noise_of(recording, build_plant(plant, "a tank"))))
    assert found[1] == pytest.approx(20.0 * found[0]) and found[0] > 0.0
