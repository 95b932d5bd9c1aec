"""Input of a job from a run file: recordings, simulated truth, parameters to estimate, settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from fdi_torch.config.estimation import EstimationConfig, estimated_space, parameter_values, placements_of
from fdi_torch.config.loaded_recordings import LoadedRecording, load_recordings
from fdi_torch.config.problems import ConfigError, naming, naming_source
from fdi_torch.config.run_file import Run
from fdi_torch.config.simulation import noise_std, planned_recording
from fdi_torch.device import usable_device
from fdi_torch.effects import build_network
from fdi_torch.estimate.fitting import Fitting, set_up, start_levels
from fdi_torch.estimate.levenberg_marquardt import RefineSettings
from fdi_torch.estimate.refinement import HybridSettings
from fdi_torch.gap.preprocess.acquisition import usable
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.description import with_unlimited_sensors
from fdi_torch.plant.operating_range import bounded_by_recording
from fdi_torch.recording import Recording
from fdi_torch.recordings.plant_limits import input_findings
from fdi_torch.simulate.simulated_recording import clean_readings, limited, with_noise


def recordings_of(run: Run) -> list[LoadedRecording]:
    """The recordings of a run file without unusable readings, or the simulated recording that it asks for."""
    if run.config.simulate is None:
        with naming_source(run.source):
            loaded = load_recordings(run.config.recordings, run.plant, run.base)
        parts = [replace(part, recording=_usable_readings(run, part.recording)) for part in loaded]
        for part in parts:
            if not bool(part.recording.mask.any()):
                raise ConfigError([f"{part.recording.source}: expected readings, got none: all are missing or masked"])
        return parts
    return [LoadedRecording(simulate_recording(run), run.config.simulate.start_levels)]


def _usable_readings(run: Run, recording: Recording) -> Recording:
    """The recording without readings of stuck sensors.

    Raises ValueError if units, channels or clocks are wrong, and if a sensor is stuck throughout but the objective
    needs its correlation.
    """
    checked = usable(run.plant, recording)
    objectives = run.config.estimate.objective.search, run.config.estimate.objective.refine
    stuck_throughout = [s for s in checked.stuck if not len(checked.recording.valid_readings(s.sensor.column))]
    if stuck_throughout and "correlation" in objectives:
        raise ValueError(
            f"{recording.source}: expected readings that vary, but {stuck_throughout[0].text}; leave the sensor out of "
            "the plant file, or use the objective 'likelihood'"
        )
    return checked.recording


def simulate_recording(run: Run) -> Recording:
    """Simulate what `simulate:` of a run file describes, with faults and noise. Deterministic for a seed.

    Commands beyond the limits of a pump or valve, which the plant cuts, are notes of the recording.
    """
    config = run.config.simulate
    if config is None:
        raise ValueError(f"{run.source}: expected simulate, got none; fdi new run writes a file that shows its keys")
    with naming_source(run.source):
        planned = planned_recording(config, run.plant)
        with naming("simulate.faults"):
            placements = placements_of(config.faults, run.plant)
    network = build_network(run.plant, placements)
    levels, _ = start_levels(run.plant, network, planned, config.start_levels)
    tanks = tuple(replace(t, start_level=float(h)) for t, h in zip(run.plant.tanks, levels, strict=True))
    plant = replace(run.plant, tanks=tanks)
    network = build_network(plant, placements)
    with naming_source(run.source):
        values = parameter_values(config.faults, network.constants, run.plant)
        _expect_onsets_within(config.duration, values)
        clean = clean_readings(build_network(with_unlimited_sensors(plant), placements), planned, values)
        std = noise_std(config.noise, run.plant, limited(clean, plant))
    seed = run.config.seed if config.seed is None else config.seed
    generator = torch.Generator().manual_seed(seed)
    notes = tuple(f"{finding.channel} {finding.text}" for finding in input_findings(planned, run.plant))
    recording = with_noise(planned, clean, std, generator, network, values)
    return replace(recording, notes=notes)


def _expect_onsets_within(duration: float, values: Mapping[str, float]) -> None:
    """Raises ConfigError for a fault that would begin after the end, s, and thus never show."""
    for name, onset in values.items():
        if ParameterName.parse(name).field == "onset" and onset >= duration:
            expected = f"less than the duration of {duration:g} s"
            raise ConfigError([f"expected {expected}, got {onset:g} s"], f"simulate.faults.{name}")


def simulated_truth(run: Run) -> dict[str, float]:
    """Values of the simulated faults, SI by full name; empty for real data."""
    if run.config.simulate is None:
        return {}
    network = build_network(run.plant, placements_of(run.config.simulate.faults, run.plant))
    return parameter_values(run.config.simulate.faults, network.constants, run.plant)


def requested_space(run: Run) -> ParameterSpace:
    """The parameters to estimate, and the constants to calibrate with them."""
    config = run.config.estimate
    if not config.parameters:
        place = run.source.at("estimate.parameters")
        raise ValueError(f"{place}: expected at least one, got none; name some, as in T1.leak")
    with naming_source(run.source):
        with naming("estimate.parameters"):
            network = build_network(run.plant, placements_of([p.name for p in config.parameters], run.plant))
        return estimated_space(config, network.constants, run.plant, bool(run.config.recordings))


def fitting_of(run: Run, space: ParameterSpace, loaded: Sequence[LoadedRecording]) -> Fitting:
    """The estimation problem of parameters and recordings, with all tensors on the configured device."""
    device = usable_device(run.config.device)
    recordings = [part.recording.to(device) for part in loaded]
    space = bounded_by_recording(space, max(float(r.time[-1] - r.time[0]) for r in recordings))
    fitting = set_up(run.plant, recordings, space, [part.start_levels for part in loaded], run.config.engine)
    expect_enough_samples(recordings, fitting.space)
    return fitting


def expect_enough_samples(recordings: Sequence[Recording], space: ParameterSpace) -> None:
    """Raises ValueError unless there are more readings than parameters, including initial levels."""
    readings = sum(int(r.mask.sum()) for r in recordings)
    if readings <= len(space):
        source = recordings[0].source
        raise ValueError(
            f"{source}: expected more readings than parameters, got {readings} readings for {len(space)} parameters; "
            "take a longer stretch or fewer parameters"
        )


def hybrid_settings(config: EstimationConfig) -> HybridSettings:
    steps = [None if step == "auto" else float(step) for step in (config.step.search, config.step.refine)]
    return HybridSettings(
        objectives=(config.objective.search, config.objective.refine),
        search=config.search,
        method=config.refine.method,
        refine=RefineSettings(iterations=config.refine.iterations),
        search_step=steps[0],
        refine_step=steps[1],
        confidence=config.confidence,
    )
