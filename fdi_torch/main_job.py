"""The main job: from a run file to a diagnosed fault, logged. `fdi train` calls it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import torch

from fdi_torch.config.estimation import EstimationConfig, estimated_space, parameter_values, placements_of
from fdi_torch.config.recordings import LoadedRecording, load_recordings
from fdi_torch.config.run import Run
from fdi_torch.config.simulation import noise_std, planned_recording
from fdi_torch.effects import build_network
from fdi_torch.estimate.evolution import Search
from fdi_torch.estimate.fitting import Fitting, set_up, start_levels
from fdi_torch.estimate.hybrid import HybridResult, HybridSettings, estimate_parameters
from fdi_torch.estimate.refine import Progress, RefineSettings
from fdi_torch.logbook import Message, RunLog, last_state, unfinished
from fdi_torch.parameters import ParameterSpace
from fdi_torch.recording import Recording
from fdi_torch.report.fit_figure import fit_figure, save
from fdi_torch.simulate.record import clean_readings, with_noise

Tell = Callable[[float, str], None]

# What a resumed run takes over from the log of the killed one.
KEPT = ("/plant/input", "/plant/output", "/plant/truth", "/estimator/de/generation", "/estimator/de/population")


@dataclass(frozen=True)
class TrainResult:
    """result: the estimate and its diagnosis. truth: the simulated values by name, empty for real data."""

    result: HybridResult
    fitting: Fitting
    truth: dict[str, float]
    log: Path
    pictures: tuple[Path, ...]


def train(run: Run, tell: Tell | None = None, resume: bool = False) -> TrainResult:
    """Loads or simulates, estimates, diagnoses, logs and draws what a run file asks for.

    tell(share, text) is called as work goes on. What was computed before an error or Ctrl-C stays readable in the log.
    resume: goes on from the last generation that a killed run of the same file logged, and ends as it would have.
    """
    tell = tell or (lambda share, text: None)
    space = wanted_space(run)
    tell(0.0, "reading" if run.config.recordings else "simulating the recording")
    loaded = recordings_of(run)
    fitting = fitting_of(run, space, loaded)
    truth = simulated_truth(run)
    folder = Path(run.config.output.folder)
    path = killed_path(folder, run.name) if resume else free_path(folder, run.name)
    before, search = left_behind(path, run) if resume else ((), None)
    with RunLog(path, "train", **origin_of(run, loaded)) as log:
        if not log.carry_over(before):
            log_recordings(log, loaded, truth)
        result = estimate_logged(run, fitting, log, tell, search)
        pictures = draw(run, fitting, result, path)
    tell(1.0, "done")
    return TrainResult(result, fitting, truth, path, pictures)


def estimate_logged(run: Run, fitting: Fitting, log: RunLog, tell: Tell, resume: Search | None = None) -> HybridResult:
    """The estimate, each of its steps and its result in the log."""
    settings = hybrid_settings(run.config.estimate)
    watch = Watch(log, fitting.space, settings, tell)
    with usable_device(run.config.device):
        result = estimate_parameters(fitting, settings, run.config.seed, watch.generation, watch.iteration, resume)
    log_result(log, result, fitting.space)
    return result


def origin_of(run: Run, loaded: Sequence[LoadedRecording]) -> dict[str, Any]:
    """What a log says of where its run comes from."""
    return {
        "config_text": run.text,
        "config": run.resolved,
        "seeds": {"seed": run.config.seed},
        "data": [{"path": part.recording.source, "sha256": part.recording.sha256} for part in loaded],
    }


def recordings_of(run: Run) -> list[LoadedRecording]:
    """The recordings that a run file names, or the one that it asks to simulate."""
    if run.config.simulate is None:
        return load_recordings(run.config.recordings, run.plant, run.base)
    return [LoadedRecording(simulate_recording(run), run.config.simulate.start_levels)]


def simulate_recording(run: Run) -> Recording:
    """The recording that `simulate:` of a run file describes, with its faults and its noise; repeats for a seed."""
    config = run.config.simulate
    if config is None:
        raise ValueError(f"{run.source}: expected simulate, got none; say what is to be simulated")
    planned = planned_recording(config, run.plant)
    placements = placements_of(config.faults, run.plant)
    network = build_network(run.plant, placements)
    levels, _ = start_levels(run.plant, network, planned, config.start_levels)
    tanks = tuple(replace(t, start_level=float(h)) for t, h in zip(run.plant.tanks, levels, strict=True))
    network = build_network(replace(run.plant, tanks=tanks), placements)
    clean = clean_readings(network, planned, parameter_values(config.faults, network.constants, run.plant))
    seed = run.config.seed if config.seed is None else config.seed
    generator = torch.Generator().manual_seed(seed)
    return with_noise(planned, clean, noise_std(config.noise, run.plant, clean), generator, network)


def simulated_truth(run: Run) -> dict[str, float]:
    """The faults that were simulated, SI by full name; empty for real data."""
    if run.config.simulate is None:
        return {}
    network = build_network(run.plant, placements_of(run.config.simulate.faults, run.plant))
    return parameter_values(run.config.simulate.faults, network.constants, run.plant)


def wanted_space(run: Run) -> ParameterSpace:
    """The parameters that the run file asks for, and the constants to calibrate beside them."""
    config = run.config.estimate
    if not config.parameters:
        raise ValueError(
            f"{run.source}: estimate.parameters: expected at least one, got none; name some, as in T1.leak"
        )
    network = build_network(run.plant, placements_of([p.name for p in config.parameters], run.plant))
    return estimated_space(config, network.constants, run.plant, bool(run.config.recordings))


def usable_device(name: str) -> torch.device:
    """The device of that name. Raises ValueError where this machine or this torch lacks it."""
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device: expected one that torch can use here, such as cpu, got '{name}'") from error
    return torch.device(name)


def fitting_of(run: Run, space: ParameterSpace, loaded: Sequence[LoadedRecording]) -> Fitting:
    """These parameters on these recordings, with all tensors on the device that the run file asks for."""
    device = usable_device(run.config.device)
    recordings = [part.recording.to(device) for part in loaded]
    expect_enough_samples(recordings, space)
    with device:
        return set_up(run.plant, recordings, space, [part.start_levels for part in loaded], run.config.engine)


def expect_enough_samples(recordings: Sequence[Recording], space: ParameterSpace) -> None:
    """Raises ValueError where there are fewer readings than parameters."""
    readings = sum(int(r.mask.sum()) for r in recordings)
    if readings <= len(space):
        source = recordings[0].source
        raise ValueError(
            f"{source}: expected more readings than parameters, got {readings} readings for {len(space)} parameters; "
            "take a longer stretch or fewer parameters"
        )


def hybrid_settings(config: EstimationConfig) -> HybridSettings:
    """The run file's settings in the estimator's own form."""
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


class Watch:
    """Logs each generation and iteration as it comes, and tells how far the work is."""

    def __init__(self, log: RunLog, space: ParameterSpace, settings: HybridSettings, tell: Tell) -> None:
        self.log, self.space, self.settings, self.tell = log, space, settings, tell
        self.iterations = 0

    def generation(self, search: Search) -> None:
        state = search.state
        best = dict(zip(self.space.names, state.population[0, 0].tolist(), strict=True))
        cost = float(state.cost[0, 0])
        self.log.generation(
            state.generation,
            cost,
            best,
            mean_cost=float(state.cost[0].mean()),
            evaluations=state.evaluations,
            units={p.name: p.unit for p in self.space},
        )
        self.log.population(state.generation, search.to_dict())
        share = 0.05 + 0.8 * state.evaluations / self.settings.search.evaluations
        self.tell(min(share, 0.85), f"search: generation {state.generation}, cost {cost:.3g}")

    def iteration(self, progress: Progress) -> None:
        self.iterations += 1
        for k, lane in enumerate(progress.lanes.tolist()):
            values = dict(zip(self.space.names, progress.theta[k].tolist(), strict=True))
            self.log.iteration(
                progress.iteration,
                float(progress.cost[k]),
                values,
                damping=float(progress.damping[k]),
                accepted=bool(progress.accepted[k]),
                problem=lane,
                t=float(self.iterations),
                units={p.name: p.unit for p in self.space},
            )
        self.tell(0.9, f"refinement: iteration {progress.iteration}, cost {float(progress.cost.min()):.6g}")


def log_recordings(log: RunLog, loaded: Sequence[LoadedRecording], truth: dict[str, float]) -> None:
    """Inputs and outputs of every recording, and what was simulated; then to disk."""
    for k, part in enumerate(loaded):
        r = part.recording
        log.recording(
            r.time,
            r.inputs,
            r.outputs,
            r.input_names,
            r.output_names,
            r.input_units,
            r.output_units,
            mask=r.mask,
            hold=r.hold,
            group="" if len(loaded) == 1 else str(k + 1),
        )
    if truth:
        log.write("/plant/truth", truth, 0.0)
    log.flush()


def log_result(log: RunLog, result: HybridResult, space: ParameterSpace) -> None:
    """The final estimate and every finding of the diagnosis."""
    final = result.estimate
    log.estimate(
        final.names,
        final.value,
        final.std,
        final.covariance,
        final.status,
        units=final.units,
        at_bound=tuple(final.at_bounds),
        unidentifiable=final.undetermined,
    )
    for fault in result.diagnosis.faults:
        location, _, effect = fault.name.partition(".")
        sizes = {"size": fault.value, "size_std": fault.std, "flow": fault.flow, "hole_diameter": fault.hole}
        known: dict[str, Any] = {name: number for name, number in sizes.items() if number is not None}
        log.fault(effect, location, fault.present, unit=fault.unit, **known)
    several = len(result.predicted) > 1
    log.result_arrays(**{f"predicted_{k + 1}" if several else "predicted": p for k, p in enumerate(result.predicted)})
    log.result(final.to_dict() | {"kind": result.diagnosis.kind, "explained": result.diagnosis.explained})
    if final.status != "converged":
        log.set_status("not_converged", final.status)


def draw(run: Run, fitting: Fitting, result: HybridResult, log: Path) -> tuple[Path, ...]:
    """One picture a recording, beside the log."""
    paths = []
    for k, (recording, predicted) in enumerate(zip(fitting.recordings, result.predicted, strict=True)):
        suffix = "" if len(fitting.recordings) == 1 else f"_{k + 1}"
        figure = fit_figure(recording, predicted, f"{run.name}: {result.diagnosis.kind}")
        paths.append(save(figure, log.with_name(f"{log.stem}{suffix}.png")))
    return tuple(paths)


def killed_path(folder: Path, name: str) -> Path:
    """The newest log of that name that was never finished. Raises ValueError where there is none."""
    partials = [
        p
        for p in folder.glob(f"{name}*.mcap.partial")
        if p.name.split(".")[0].removeprefix(name).strip("_0123456789") == ""
    ]
    if not partials:
        raise ValueError(f"{folder}: expected an unfinished log {name}.mcap.partial, got none; start without --resume")
    return max(partials, key=lambda p: p.stat().st_mtime).with_suffix("")


def left_behind(path: Path, run: Run) -> tuple[tuple[Message, ...], Search | None]:
    """What a killed run logged until its last whole generation, and the state of its search there."""
    before = unfinished(path)
    if before is None or before.config_text != run.text:
        raise ValueError(f"{path}.partial: expected the log of this very run, got another; start without --resume")
    state = last_state(before)
    if state is None:
        return (), None
    generation, arrays = state
    kept = (m for m in before.messages() if m.topic in KEPT and m.payload.get("generation", 0) <= generation)
    return tuple(kept), Search.from_dict({name: torch.tensor(array) for name, array in arrays.items()})


def free_path(folder: Path, name: str, ending: str = "mcap") -> Path:
    """NAME.mcap in the folder, or NAME_2.mcap, NAME_3.mcap ... where that is taken."""
    for k in count(1):
        path = folder / (f"{name}.{ending}" if k == 1 else f"{name}_{k}.{ending}")
        if not path.exists() and not path.with_name(path.name + ".partial").exists():
            return path
    raise AssertionError("unreachable")
