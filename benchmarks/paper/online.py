"""Figures 6 and 7: two faults one after the other, alarms from an observer's residual, sizes window by window.

The paper does not give the faults. They are those of run files whose windows are laid end to end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.config.estimation import parameter_values, placements_of
from fdi_torch.config.run_file import Run
from fdi_torch.config.simulation import noise_std, planned_recording
from fdi_torch.effects import build_network
from fdi_torch.estimate.fitting import set_up, start_levels
from fdi_torch.estimate.hybrid import HybridResult, estimate_parameters
from fdi_torch.jobs.run_setup import hybrid_settings, requested_space
from fdi_torch.monitor.detection import Detector, make_detector
from fdi_torch.monitor.noise_model import NoiseModel, learn_noise
from fdi_torch.monitor.observer import Observer
from fdi_torch.monitor.observer_gain import hand_gain
from fdi_torch.monitor.samples import samples_of_recording
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.recording import Recording
from fdi_torch.sample_noise import sample_noise
from fdi_torch.simulate.simulated_recording import clean_readings, with_noise

TIME_BETWEEN_FALSE_ALARMS = 20_000.0
STILL_RATIO = 1.2
"""A channel is constant if its standard deviation is less than this multiple of its sample-to-sample noise."""


@dataclass(frozen=True)
class Window:
    """begin, end s. result: None where the outputs do not vary, so that no correlation is defined.

    alarm: when the residual first left its fault-free range within the window, None where it did not. truth (P,).
    """

    begin: float
    end: float
    truth: Tensor
    alarm: float | None
    result: HybridResult | None

    @property
    def delay(self) -> float:
        """Time from the beginning of the window to the alarm, s; NaN without an alarm."""
        return float("nan") if self.alarm is None else self.alarm - self.begin


@dataclass(frozen=True)
class OnLine:
    """predicted (S, C): of the model that was fitted to each window. nominal, adaptive (S, C): residuals y - y_hat of
    the observer with nominal parameters throughout, and of the one to which each window's estimate goes back.
    """

    recording: Recording
    windows: tuple[Window, ...]
    predicted: Tensor
    nominal: Tensor
    adaptive: Tensor


def follow(runs: Sequence[Run]) -> OnLine:
    """The windows that the runs simulate, one after the other; the last run defines the estimation and the seed."""
    recording, fault_free, network, space = laid_end_to_end(runs)
    noise, detector = learnt(network, fault_free, runs[-1].config.seed)
    # Start levels are known, at rest as after a fit: no opening gain.
    gain = hand_gain(noise.gain.steady)
    believed, levels, since = space.nominal(), start_of(runs[0], network, recording), 0.0
    nominal = Observer(network, gain).run(samples_of_recording(recording, network.description), levels).residual
    windows, predicted, adaptive, begin = [], [], [], 0.0
    for run in runs:
        assert run.config.simulate is not None
        end = begin + run.config.simulate.duration
        part = recording.window(begin, end)
        # The observer runs on until its parameters change.
        observed = samples_of_recording(recording.window(since, end), network.description)
        seen = Observer(network, gain, space, believed).run(observed, levels)
        residual = seen.residual[-len(part) :]
        alarm = first_alarm(part.time, noise.whitening(seen.steady_residual[-len(part) :]), detector)
        result = sized(part, space, runs[-1]) if varies(part) else None
        windows.append(Window(begin, end, space.vector(faults_of(run, network)), alarm, result))
        own = part.outputs - residual if result is None else result.predicted[0]
        # Two windows share the sample between them; it belongs to the first.
        predicted.append(own if begin == 0.0 else own[1:])
        adaptive.append(residual if begin == 0.0 else residual[1:])
        if result is not None:
            (believed, levels), since = fed_back(result, len(space)), end
        begin = end
    return OnLine(recording, tuple(windows), torch.cat(predicted), nominal, torch.cat(adaptive))


def laid_end_to_end(runs: Sequence[Run]) -> tuple[Recording, Recording, TankNetwork, ParameterSpace]:
    """The recording, one without faults under the same noise, the plant with its faults, and those (as estimated).

    Each window starts from the levels at which the one before it ends. The noise is that of the last run, against the
    signal of the whole.
    """
    last = runs[-1]
    assert last.config.simulate is not None
    network = faulty_network(last)
    space = requested_space(last)
    pieces: list[Tensor] = []
    levels = None
    for run in runs:
        assert run.config.simulate is not None
        planned = planned_recording(run.config.simulate, run.plant)
        levels = start_of(run, network, planned) if levels is None else levels
        piece = clean_readings(started_at(network, levels), planned, faults_of(run, network))
        pieces.append(piece if not pieces else piece[1:])
        levels = piece[-1]  # the paper's sensors read the levels themselves
    clean = torch.cat(pieces)
    whole = last.config.simulate.model_copy(
        update={"duration": float(len(clean) - 1) * last.config.simulate.sample_time}
    )
    planned = planned_recording(whole, last.plant)
    std = noise_std(whole.noise, last.plant, clean)
    generator = torch.Generator().manual_seed(last.config.seed)
    recording = with_noise(planned, clean, std, generator, network)
    fault_free = with_noise(planned, clean[:1].expand_as(clean), std, generator, network)
    return recording, fault_free, network, space


def faulty_network(run: Run) -> TankNetwork:
    """The plant with every estimated fault, all at nominal."""
    return build_network(run.plant, placements_of([p.name for p in run.config.estimate.parameters], run.plant))


def faults_of(run: Run, network: TankNetwork) -> dict[str, float]:
    """Simulated values, SI by full name."""
    assert run.config.simulate is not None
    return parameter_values(run.config.simulate.faults, network.constants, run.plant)


def start_of(run: Run, network: TankNetwork, recording: Recording) -> Tensor:
    """Initial levels (tanks,) of the run, m."""
    assert run.config.simulate is not None
    return start_levels(run.plant, network, recording, run.config.simulate.start_levels)[0]


def started_at(network: TankNetwork, levels: Tensor) -> TankNetwork:
    plant = network.description
    tanks = tuple(replace(t, start_level=float(h)) for t, h in zip(plant.tanks, levels, strict=True))
    return build_network(replace(plant, tanks=tanks), network.placements)


def learnt(network: TankNetwork, fault_free: Recording, seed: int) -> tuple[NoiseModel, Detector]:
    """Noise model and observer gain from a fault-free recording, and a detector with rare false alarms."""
    noise, _ = learn_noise(network, samples_of_recording(fault_free, network.description))
    sampling = float(torch.diff(fault_free.time).median())
    generator = torch.Generator().manual_seed(seed)
    channels = len(network.description.sensors)
    return noise, make_detector("cusum", TIME_BETWEEN_FALSE_ALARMS, sampling, channels, generator)


def first_alarm(time: Tensor, white: Tensor, detector: Detector) -> float | None:
    """Time of the first alarm of the white residual, s."""
    alarms = detector.alarms(white).nonzero()
    return float(time[alarms[0, 0]]) if len(alarms) else None


def varies(recording: Recording) -> bool:
    """Whether every output varies by more than its noise; the correlation of a constant output is undefined."""
    noise = sample_noise(recording.outputs, recording.mask.to(recording.outputs.dtype))
    return bool((recording.outputs.std(dim=0) > STILL_RATIO * noise).all())


def sized(recording: Recording, space: ParameterSpace, run: Run) -> HybridResult:
    """The faults of one window, estimated together with its initial levels, which are known from noisy
    readings only.
    """
    fitting = set_up(run.plant, [recording], space, "free", run.config.engine)
    return estimate_parameters(fitting, hybrid_settings(run.config.estimate), run.config.seed)


def fed_back(result: HybridResult, faults: int) -> tuple[Tensor, Tensor]:
    """Parameters (P,) for the adaptive observer (16), and the levels (tanks,) at the end of the window."""
    return result.estimate.value[:faults], result.predicted[0][-1]
