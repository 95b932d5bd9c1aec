"""The train job: estimate and diagnose the faults of a run file, with a log and pictures, for `fdi train`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fdi_torch.config.loaded_recordings import LoadedRecording
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.run_file import Run
from fdi_torch.estimate.evolution import Search
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.hybrid import HybridResult, estimate_parameters
from fdi_torch.estimate.levenberg_marquardt import Progress
from fdi_torch.estimate.posterior_draws import Draws
from fdi_torch.estimate.profile import Profile
from fdi_torch.estimate.refinement import HybridSettings
from fdi_torch.estimate.uncertainty import Estimate
from fdi_torch.gap.preprocess.acquisition import thorough_findings
from fdi_torch.jobs.estimate_uncertainty import profiled_names, profiles_of, with_draws
from fdi_torch.jobs.log_paths import RESUMES, log_to_write, unfinished_search
from fdi_torch.jobs.logged_recordings import log_prediction, log_recording
from fdi_torch.jobs.run_setup import fitting_of, hybrid_settings, recordings_of, requested_space, simulated_truth
from fdi_torch.logbook import Listener, RunLog, as_array
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.exact_constants import without_tolerance_sentence
from fdi_torch.progress import Tell, rounded, silent
from fdi_torch.recordings.check import doubts_about
from fdi_torch.report.fit_figure import fit_figure
from fdi_torch.report.numbers import estimate_table
from fdi_torch.report.style import notebook_svg, save
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units, needed

STATE = "/estimator/de/population"
GENERATION, ITERATION = "/estimator/de/generation", "/estimator/refine/iteration"
# Share of the progress at which draws begin: they take most of the time.
ESTIMATED_BEFORE_DRAWS = 0.3


@dataclass(frozen=True, repr=False)
class TrainResult(Shown):
    """result: estimate and diagnosis. truth: simulated values by name, empty for real data. profiles: as asked for.
    doubts: what limits the trust in the recordings, one sentence each."""

    result: HybridResult
    fitting: Fitting
    truth: dict[str, float]
    log: Path
    pictures: tuple[Path, ...]
    profiles: tuple[Profile, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def estimate(self) -> Estimate:
        """Values, standard errors and covariance of the parameters."""
        return self.result.estimate

    @property
    @in_its_units
    def headline(self) -> str:
        """The diagnosis in one sentence; it begins with a warning if the model does not explain the recording."""
        return self.result.headline

    @property
    def exact_constants(self) -> str:
        """A sentence about the constants that count as exact for lack of a tolerance; empty if there are none."""
        names = self.fitting.networks[0].constants.names
        return without_tolerance_sentence(self.fitting.plant, self.fitting.space.names, names)

    @in_its_units
    def table(self) -> Table:
        """One row per parameter, in its unit for display."""
        table, values = self.estimate.table(), [self.fitting.space.nominal().tolist()]
        values += [[self.truth.get(p.name, math.nan) for p in self.fitting.space]] if self.truth else []
        rows = [
            (*row, *in_display_unit(p.name, p.unit, *exact)[1:])
            for row, p, *exact in zip(table.rows, self.fitting.space, *values, strict=True)
        ]
        return Table([*table.header, *("nominal", "simulated")[: len(values)]], rows)

    @in_its_units
    def brief(self) -> Table:
        """The estimates and their determined combinations, as `fdi train` prints them."""
        final, space = self.estimate, self.fitting.space
        exact = {"nominal": {p.name: p.nominal for p in space}} | ({"simulated": self.truth} if self.truth else {})
        columns = (final.names, final.units, final.value.tolist(), final.std.tolist())
        return estimate_table("", *columns, combinations=final.combinations, exact=exact, **final.limits)

    @in_its_units
    def picture(self) -> str:
        """Readings and fit of the first recording, as SVG."""
        figure = fit_figure(
            self.fitting.recordings[0], {"estimate": self.result.predicted[0]}, self.headline, self.fitting.plant
        )
        return notebook_svg(figure, self.log.stem, self.headline)

    @in_its_units
    def profile(self, *names: str, confidence: float = 0.95) -> tuple[Profile, ...]:
        """Profile likelihoods of the named parameters, of all if none is named; see `profile_likelihood`."""
        return profiles_of(self.fitting, self.result, names or self.result.estimate.names, confidence)

    @in_its_units
    def sample(self, draws: int = 1000, seed: int = 0, most_steps: int = 16_000, tell: Tell = silent) -> Draws:
        """Draws from the posterior (extra `draws`); see `draw_posterior`. tell: as of `train`; it may take minutes."""
        drawn = with_draws(self.fitting, self.result, draws, seed, most_steps, rounded(tell)).estimate.draws
        assert drawn is not None
        return drawn

    def to_arviz(self) -> Any:
        """The draws that the run asked for, as `Estimate.to_arviz`; those of `sample` have a method of their own."""
        return self.estimate.to_arviz()

    def to_xarray(self, recording: int = 0) -> Any:
        """An xarray.Dataset (extra `xarray`) of measured, predicted and residual over time and sensor, SI."""
        return self.fitting.recordings[recording].compared(self.result.predicted[recording])


def train(run: Run, tell: Tell = silent, resume: bool = False, listener: Listener | None = None) -> TrainResult:
    """Carry out a run file: load or simulate the recordings, estimate, diagnose, log and draw.

    tell(share, text): progress. Results before an error or Ctrl-C stay readable in the log. resume: continue from the
    last generation in the log of a killed or interrupted run of the same file; the result is the same as without the
    interruption. listener: receives every log message.
    """
    if run.config.estimate.windows is not None:
        place = run.source.at("estimate.windows")
        raise ConfigError([f"{place}: expected none, got {run.config.estimate.windows:g} s; fdi train fits windows"])
    space = requested_space(run)
    tell(0.0, "reading" if run.config.recordings else "simulating the recording")
    loaded = recordings_of(run)
    fitting = fitting_of(run, space, loaded)
    truth = simulated_truth(run)
    path, unfinished = log_to_write(Path(run.config.output.folder), run.name, run.text, resume)
    before, search = unfinished_search(unfinished, run.config.device)
    records = run.log_records(part.recording.origin for part in loaded)
    with RunLog(path, "train", **records, listener=listener, after_interruption=RESUMES) as log:
        if not log.carry_over(before):
            log_recordings(log, loaded, truth)
        doubts = doubts_about([part.recording for part in loaded], run.plant)
        result, profiles, doubts = estimate_logged(run, fitting, log, tell, search, doubts)
        pictures = draw(run, fitting, result, path)
    tell(1.0, "done")
    return TrainResult(result, fitting, truth, path, pictures, profiles, doubts)


def estimate_logged(
    run: Run, fitting: Fitting, log: RunLog, tell: Tell, resume: Search | None = None, doubts: Sequence[str] = ()
) -> tuple[HybridResult, tuple[Profile, ...], tuple[str, ...]]:
    """Estimate the parameters, with the profiles and draws asked for, and log each step and the result.

    Returns also the doubts about the recordings: those given, after what a thorough examination finds in recordings
    that the model does not explain. It takes too long to precede every fit.
    """
    config, settings = run.config.estimate, hybrid_settings(run.config.estimate)
    profiled = profiled_names(run, fitting.space)
    if config.draws:
        needed("emcee", "draws")
    until = ESTIMATED_BEFORE_DRAWS if config.draws else 1.0
    watch = SearchLogger(log, fitting.space, settings, lambda share, text: tell(share and until * share, text))
    result = estimate_parameters(fitting, settings, run.config.seed, watch.generation, watch.iteration, resume)
    profiles = profiles_of(fitting, result, profiled, config.confidence) if profiled else ()
    if config.draws:

        def tell_draws(share: float | None, text: str) -> None:
            tell(None if share is None else until + (1.0 - until) * share, text)

        result = with_draws(fitting, result, config.draws, run.config.seed, tell=tell_draws)
    if run.config.recordings and not result.diagnosis.misfit.explained:
        tell(0.95, "examining the recordings")
        doubts = (*thorough_findings(run.plant, [r.to(torch.device("cpu")) for r in fitting.recordings]), *doubts)
    doubts = (*result.diagnosis.misfit.remarks, *doubts)
    log_result(log, result, fitting.space, profiles, doubts)
    each = zip(fitting.recordings, result.predicted, result.noise, strict=True)
    for k, (recording, predicted, noise) in enumerate(each):
        log_prediction(log, recording, predicted, group_of(k, len(fitting.recordings)), noise)
    return result, profiles, doubts


class SearchLogger:
    """Logs the generations of the search and the iterations of the refinement, and reports progress."""

    def __init__(self, log: RunLog, space: ParameterSpace, settings: HybridSettings, tell: Tell) -> None:
        self.log, self.settings, self.tell = log, settings, tell
        self.names, self.units = space.names, {p.name: p.unit for p in space}
        self.iterations = 0

    def generation(self, search: Search) -> None:
        """Log a generation and its best member, and the complete state if it is due."""
        state = search.state
        costs = as_array(state.cost)[0]
        row: dict[str, Any] = {"problem": 0, "generation": state.generation}
        row |= {"best_cost": float(costs[0]), "mean_cost": float(np.mean(costs))}
        row |= {"evaluations": state.evaluations, **dict(zip(self.names, state.population[0, 0].tolist(), strict=True))}
        self.log.write(GENERATION, row, state.generation, units=self.units)
        if state_is_due(state.generation):
            self.log.population(state.generation, search.to_dict())
        share = 0.05 + 0.8 * state.evaluations / self.settings.search.evaluations
        self.tell(min(share, 0.85), f"search: generation {state.generation}, cost {float(costs[0]):.3g}")

    def iteration(self, progress: Progress) -> None:
        self.iterations += 1
        for k in range(len(progress.lanes)):
            row: dict[str, Any] = {
                "problem": int(progress.lanes[k]),
                "iteration": progress.iteration,
                "cost": float(progress.cost[k]),
            }
            row |= {"damping": float(progress.damping[k]), "accepted": bool(progress.accepted[k])}
            row |= dict(zip(self.names, progress.theta[k].tolist(), strict=True))
            self.log.write(ITERATION, row, self.iterations, units=self.units)
        self.tell(0.9, f"refinement: iteration {progress.iteration}, cost {float(progress.cost.min()):.6g}")


def state_is_due(generation: int) -> bool:
    """Whether the complete search state is logged: a resumed run repeats at most 32 generations, or an eighth."""
    return generation % (1 << max(5, generation.bit_length() - 4)) == 0


def log_recordings(log: RunLog, loaded: Sequence[LoadedRecording], truth: dict[str, float]) -> None:
    """Log every recording and the simulated truth, and flush them to disk."""
    for k, part in enumerate(loaded):
        log_recording(log, part.recording, group_of(k, len(loaded)))
    if truth:
        log.write("/plant/truth", truth, 0.0)
    log.flush()


def group_of(k: int, count: int) -> str:
    """Log group of recording k of several."""
    return "" if count == 1 else str(k + 1)


def log_result(
    log: RunLog,
    result: HybridResult,
    space: ParameterSpace,
    profiles: Sequence[Profile] = (),
    doubts: Sequence[str] = (),
) -> None:
    """Log the final estimate with its profiles and draws, the diagnosis of each fault, and doubts about recordings."""
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
        name = ParameterName.parse(fault.name)
        sizes = {"size": fault.value, "size_std": fault.std, "flow": fault.flow, "hole_diameter": fault.hole}
        present: dict[str, Any] = {key: number for key, number in sizes.items() if number is not None}
        log.fault(name.at_place, name.place, fault.present, unit=fault.unit, **present)
    several = len(result.predicted) > 1
    log.result_arrays(**{f"predicted_{k + 1}" if several else "predicted": p for k, p in enumerate(result.predicted)})
    more: dict[str, Any] = {"profiles": [profile.to_dict() for profile in profiles]} if profiles else {}
    if doubts:
        more["doubts"] = list(doubts)
    if final.draws is not None:
        log.result_arrays(draws=final.draws.values)
        more["draws"] = final.draws.to_dict()
    diagnosis = result.diagnosis
    more["not_isolated"] = [combination.to_dict() for combination in diagnosis.not_isolated]
    more["rivals"] = [diagnosis.rivals.to_dict()] if diagnosis.rivals else []
    log.result(final.to_dict() | {"kind": diagnosis.kind} | diagnosis.misfit.to_dict() | more)
    if final.status != "converged":
        log.set_status("not_converged", final.status)


def draw(run: Run, fitting: Fitting, result: HybridResult, log: Path) -> tuple[Path, ...]:
    """Draw one picture per recording, next to the log."""
    paths = []
    for k, (recording, predicted) in enumerate(zip(fitting.recordings, result.predicted, strict=True)):
        suffix = "" if len(fitting.recordings) == 1 else f"_{k + 1}"
        figure = fit_figure(recording, {"estimate": predicted}, f"{run.name}: {result.diagnosis.headline}", run.plant)
        paths.append(save(figure, log.with_name(f"{log.stem}{suffix}.png")))
    return tuple(paths)
