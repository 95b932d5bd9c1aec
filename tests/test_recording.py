"""Recording: selection of segments on one clock, and rejected arguments."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fdi_torch.recording import Recording


def recording(time: list[float], command: list[float], level: list[float]) -> Recording:
    column = {"dtype": torch.float64}
    return Recording(
        time=torch.tensor(time, **column),
        inputs=torch.tensor(command, **column)[:, None],
        outputs=torch.tensor(level, **column)[:, None],
        input_names=("Q1",),
        output_names=("h1",),
        input_units=("m^3/s",),
        output_units=("m",),
        source="test.csv",
    )


def ramp(samples: int) -> Recording:
    numbers = [float(i) for i in range(samples)]
    return recording(numbers, numbers, numbers)


def test_missing_readings_do_not_count() -> None:
    assert recording([0, 1, 2], [1, 1, 1], [1, float("nan"), 3]).mask.flatten().tolist() == [True, False, True]


def test_a_reading_that_is_no_number_does_not_count_whatever_the_mask_says() -> None:
    gap = replace(ramp(3), outputs=torch.tensor([[1.0], [float("nan")], [3.0]]).double())
    assert gap.mask.flatten().tolist() == [True, False, True]
    assert gap.valid_readings("h1").tolist() == [1.0, 3.0]


def test_window_keeps_the_clock() -> None:
    assert ramp(10).window(2.0, 5.0).time.tolist() == [2, 3, 4, 5]


def test_window_without_samples_says_how_far_the_recording_runs() -> None:
    with pytest.raises(
        ValueError, match=r"test.csv: expected at least two samples after start 20 s, got .* from 0 s to 9 s"
    ):
        ramp(10).window(start=20.0)


def test_masked_readings_stop_counting_and_inputs_stay() -> None:
    masked = ramp(6).masked([(1.0, 2.0), (4.5, 9.0)])
    assert masked.mask.flatten().tolist() == [True, False, False, True, True, False]
    assert torch.equal(masked.inputs, ramp(6).inputs)


def test_what_may_have_been_on_before_a_stretch_is_remembered() -> None:
    """A pump whose hose must not be empty: it ran, or nobody knows."""
    for before, ran in ((0.0, set()), (-1.0, set()), (2.0, {"Q1"}), (float("nan"), {"Q1"})):
        whole = recording([0, 1, 2, 3], [before, 0, 0, 5], [0, 0, 0, 0])
        assert whole.ran == set() and whole.stretch(2, 4).ran == ran
        assert whole.stretch(2, 4).stretch(1, 2).ran == ran, "on it goes"


def test_masks_run_forward() -> None:
    with pytest.raises(ValueError, match=r"expected masks with start < stop, got \[5, 2\] s"):
        ramp(6).masked([(5.0, 2.0)])


def test_every_keeps_the_volume_of_a_held_input() -> None:
    """The step of the command lies between kept samples; the delivered volume must not notice."""
    full = recording([0, 1, 2, 3, 4, 5], [0, 9, 9, 9, 9, 9], [0, 1, 2, 3, 4, 5])
    thin = full.every(3)
    assert thin.time.tolist() == [0, 3]
    assert float((thin.inputs * 3).sum()) == pytest.approx(float(full.inputs.sum()))


def test_every_weighs_by_how_long_a_command_is_held() -> None:
    assert recording([0, 1, 4, 5], [6, 2, 3, 3], [0, 0, 0, 0]).every(2).inputs[0].item() == pytest.approx(
        (6 + 2 * 3) / 4
    )


def test_every_keeps_the_volume_of_an_input_that_is_interpolated() -> None:
    """A pump that runs at every tenth sample ran at every one that was kept: ten times the volume."""
    pulses = recording([0, 1, 2, 3, 4, 5, 7, 9], [6, 0, 0, 0, 6, 0, 0, 2], [0] * 8)
    thinned = replace(pulses, hold="linear").every(4)
    assert (thinned.time.tolist(), thinned.hold) == ([0.0, 4.0], "zero_order")
    volume = torch.trapezoid(pulses.inputs[:, 0], pulses.time)
    assert thinned.inputs.flatten().tolist() == pytest.approx([6.0 / 4.0, (3.0 + 0.0 + 2.0 + 2.0 * 2.0) / 7.0])
    assert float(volume) == pytest.approx(float(thinned.inputs[0] * 4.0 + thinned.inputs[1] * 7.0 - 2.0 * 2.0))


def test_every_leaves_an_unknown_input_unknown() -> None:
    thin = recording([0, 1, 2, 3], [1, float("nan"), 1, 1], [0, 0, 0, 0]).every(2)
    assert torch.isnan(thin.inputs.flatten()).tolist() == [True, False]


def test_every_of_a_rig_without_commands() -> None:
    full = recording([0, 1, 2, 3], [0, 0, 0, 0], [0, 1, 2, 3])
    thin = replace(full, inputs=full.inputs[:, :0], input_names=(), input_units=()).every(2)
    assert thin.inputs.shape == (2, 0) and thin.outputs.flatten().tolist() == [0, 2]


def test_every_is_a_whole_number_from_one() -> None:
    with pytest.raises(ValueError, match="expected every to be a whole number from 1, got 0"):
        ramp(4).every(0)


def test_known_stretches_are_cut_where_an_input_is_unknown() -> None:
    nan = float("nan")
    parts = recording([0, 1, 2, 3, 4, 5], [1, 1, nan, nan, 1, 1], [0.0] * 6).known_segments()
    assert [part.time.tolist() for part in parts] == [[0, 1], [4, 5]]


def test_time_must_increase() -> None:
    with pytest.raises(ValueError, match="expected time that increases, got 1 s followed by 1 s in sample 2"):
        recording([0, 1, 1], [0, 0, 0], [0, 0, 0])


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"expected inputs of shape \(2, 1\), got \(3, 1\)"):
        recording([0, 1], [0, 0, 0], [0, 0])


def test_the_interval_is_that_of_the_sensor_read_most_often() -> None:
    """Not of rows that another sensor's clock, or an input between readings, puts a moment beside them."""
    time = torch.tensor([0.0, 0.002, 1.0, 1.4, 2.0, 2.002, 3.0, 4.0, 4.002], dtype=torch.float64)
    outputs = torch.full((9, 2), torch.nan, dtype=torch.float64)
    outputs[[0, 2, 4, 6, 7], 0], outputs[[1, 5, 8], 1] = 1.0, 2.0
    both = Recording(time, torch.zeros(9, 1), outputs, ("Q",), ("a", "b"), ("m^3/s",), ("m", "m"))
    assert both.interval == 1.0
    assert replace(both, mask=torch.zeros(9, 2, dtype=torch.bool)).interval == pytest.approx(0.4)
