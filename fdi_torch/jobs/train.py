"""The main job: from a run file to a diagnosed fault, logged. `fdi train` calls it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fdi_torch.config.loaded_recordings import LoadedRecording
from fdi_torch.config.run_file import Run
from fdi_torch.estimate.evolution import Search
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.hybrid import HybridResult, HybridSettings, estimate_parameters
from fdi_torch.estimate.levenberg_marquardt import Progress
from fdi_torch.jobs.log_paths import RESUMES, free_path, left_behind
from fdi_torch.jobs.run_setup import (
    fitting_of,
    hybrid_settings,
    recordings_of,
    simulated_truth,
    tensors_on,
    usable_device,
    wanted_space,
)
from fdi_torch.logbook import DeferredTopic, Listener, RunLog, as_array
from fdi_torch.parameters import ParameterSpace
from fdi_torch.report.fit_figure import fit_figure, save
from fdi_torch.report.style import inline_svg
from fdi_torch.tables import Shown, Table

Tell = Callable[[float, str], None]
STATE = "/estimator/de/population"
GENERATION, ITERATION = "/estimator/de/generation", "/estimator/refine/iteration"


@dataclass(frozen=True, repr=False)
class TrainResult(Shown):
    """result: the estimate and its diagnosis. truth: the simulated values by name, empty for real data."""

    result: HybridResult
    fitting: Fitting
    truth: dict[str, float]
    log: Path
    pictures: tuple[Path, ...]

    @property
    def headline(self) -> str:
        """What the diagnosis says; a model that does not explain the recording first."""
        diagnosis = self.result.diagnosis
        names = ", ".join(fault.name for fault in diagnosis.present)
        found = f"{diagnosis.kind}: {names}" if names else diagnosis.kind
        if diagnosis.explained:
            return found
        ratio = diagnosis.unexplained_ratio
        return f"the model does not explain the recording (residuals {ratio:.2g} times the noise); {found}"

    def table(self) -> Table:
        """A row a parameter, SI."""
        final = self.result.estimate
        low, high = final.interval()
        columns: dict[str, Sequence[Any]] = {"parameter": final.names, "unit": final.units}
        columns |= {"estimate": final.value.tolist(), "std error": final.std.tolist()}
        columns |= {"95 % low": low.tolist(), "95 % high": high.tolist()}
        columns["nominal"] = [p.nominal for p in self.fitting.space]
        if self.truth:
            columns["simulated"] = [self.truth.get(name) for name in final.names]
        return Table(columns)

    def picture(self) -> str:
        """Readings and fit of the first recording, as SVG."""
        fitted = fit_figure(self.fitting.recordings[0], self.result.predicted[0], self.headline)
        return str(inline_svg(fitted, self.log.stem, self.headline))

    def to_xarray(self, recording: int = 0) -> Any:
        """An xarray.Dataset (extra `xarray`) of measured, predicted and residual over time and sensor, SI."""
        return self.fitting.recordings[recording].compared(self.result.predicted[recording])


def train(run: Run, tell: Tell | None = None, resume: bool = False, listener: Listener | None = None) -> TrainResult:
    """Loads or simulates, estimates, diagnoses, logs and draws what a run file asks for.

    tell(share, text) is called as work goes on. What was computed before an error or Ctrl-C stays readable in the log.
    resume: goes on from the last generation that a killed or interrupted run of the same file logged, and ends as it
    would have.
    listener: hears every message of the log.
    """
    tell = tell or (lambda share, text: None)
    space = wanted_space(run)
    tell(0.0, "reading" if run.config.recordings else "simulating the recording")
    loaded = recordings_of(run)
    fitting = fitting_of(run, space, loaded)
    truth = simulated_truth(run)
    folder = Path(run.config.output.folder)
    path, before, search = left_behind(folder, run) if resume else (free_path(folder, run.name), (), None)
    with RunLog(path, "train", **origin_of(run, loaded), listener=listener, after_interruption=RESUMES) as log:
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
    with tensors_on(usable_device(run.config.device)):
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


class Watch:
    """Logs each generation and iteration as it comes, and tells how far the work is."""

    def __init__(self, log: RunLog, space: ParameterSpace, settings: HybridSettings, tell: Tell) -> None:
        self.log, self.settings, self.tell = log, settings, tell
        self.names = space.names
        self._fields = ("problem", "generation", "best_cost", "mean_cost", "evaluations", *space.names)
        self.iterations = 0
        units = {p.name: p.unit for p in space}
        self._generation = DeferredTopic(GENERATION, self._generations, units)
        self._iteration = DeferredTopic(ITERATION, self._iterations, units)
        self._keep, self._next_state = log.keep, 0

    def generation(self, search: Search) -> None:
        state = search.state
        self.write(search)
        share = 0.05 + 0.8 * state.evaluations / self.settings.search.evaluations
        self.tell(min(share, 0.85), f"search: generation {state.generation}, cost {float(state.cost[0, 0]):.3g}")

    def write(self, search: Search) -> None:
        """Into the log."""
        state = search.state
        generation = state.generation
        kept = generation, state.evaluations, state.cost, state.population  # the rest of a state need not be kept alive
        if generation < self._next_state and not self.log.due:
            self._keep((self._generation, kept))
            return
        self.log.later(self._generation, kept)
        if state_is_due(generation):
            self.log.population(generation, search.to_dict())
        self._next_state = next_state(generation)

    def _generations(self, kept: Sequence[tuple[int, int, Tensor, Tensor]]) -> Iterator[tuple[float, dict[str, Any]]]:
        """What is logged of each generation, worked out when their messages are written: best first, one problem."""
        costs = as_array(torch.cat([cost for *_, cost, _ in kept], 1))[0]
        start = 0
        for generation, evaluations, cost, population in kept:
            end = start + cost.shape[1]
            mean = float(np.add.reduce(costs[start:end])) / (end - start)
            best = as_array(population)[0, 0].tolist()
            row = 0, generation, float(costs[start]), mean, evaluations, *best
            yield generation, dict(zip(self._fields, row, strict=True))
            start = end

    def iteration(self, progress: Progress) -> None:
        self.iterations += 1
        for k in range(len(progress.lanes)):
            self.log.later(self._iteration, (self.iterations, progress, k))
        self.tell(0.9, f"refinement: iteration {progress.iteration}, cost {float(progress.cost.min()):.6g}")

    def _iterations(self, steps: Sequence[tuple[int, Progress, int]]) -> Iterator[tuple[float, dict[str, Any]]]:
        for number, progress, k in steps:
            told = {"problem": int(progress.lanes[k]), "iteration": progress.iteration, "cost": float(progress.cost[k])}
            told |= {"damping": float(progress.damping[k]), "accepted": bool(progress.accepted[k])}
            yield number, told | dict(zip(self.names, progress.theta[k].tolist(), strict=True))


def state_is_due(generation: int) -> bool:
    """Is the whole state of the search logged? So often that a resumed run repeats 32 generations or an eighth."""
    return generation % _spacing(generation) == 0


def next_state(generation: int) -> int:
    """The first generation after this one whose state is logged."""
    spacing = _spacing(generation + 1)
    return -(-(generation + 1) // spacing) * spacing


def _spacing(generation: int) -> int:
    return 1 << max(5, generation.bit_length() - 4)


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
