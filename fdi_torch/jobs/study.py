"""A whole study: trials computed here or on a cluster, logged as they come, resumed, summed up and drawn."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdi_torch.config.study_file import Study
from fdi_torch.jobs.log_paths import RESUMES, free_path, go_on_from
from fdi_torch.logbook import Listener, RunLog
from fdi_torch.logbook.reader import Run as OldLog
from fdi_torch.report.fit_figure import save
from fdi_torch.report.study_figures import correlation_figure, error_figure
from fdi_torch.study.cluster import run_on_cluster
from fdi_torch.study.isolation import Isolation, isolate
from fdi_torch.study.monte_carlo import Trial, run_blocks
from fdi_torch.study.plan import Plan
from fdi_torch.study.summary import Ratio, Summary, summarise
from fdi_torch.tables import Shown, Table

Tell = Callable[[float, str], None]

TRIAL = "/study/trial"
_ENVELOPE = ("t", "trial", "group", "seed", "status")


@dataclass(frozen=True, repr=False)
class StudyResult(Shown):
    """summaries: one a setting. isolation: where faults are drawn by mode. seconds: of this run's own trials."""

    summaries: tuple[Summary, ...]
    isolation: Isolation | None
    trials: dict[int, Trial]
    computed: int
    seconds: float
    log: Path
    pictures: tuple[Path, ...]

    @property
    def headline(self) -> str:
        settings = f"{len(self.summaries)} setting{'s' if len(self.summaries) != 1 else ''}"
        return f"{len(self.trials)} trials in {settings}"

    def table(self) -> Table:
        """A row a setting, estimator and parameter; bias and RMSE in the parameter's SI unit."""
        names = ("setting", "estimator", "parameter", "bias", "RMSE", "RMSE / bound", "coverage")
        rows = [
            (s.setting, e.estimator, e.parameter, e.bias, e.rmse, _value(e.over_bound), _value(e.coverage))
            for s in self.summaries
            for e in s.scores
        ]
        return Table.of_rows(names, rows)


def _value(ratio: Ratio | None) -> float | None:
    return None if ratio is None else ratio.value


def run_study(
    study: Study,
    resume: bool = False,
    cluster: str | None = None,
    tell: Tell | None = None,
    listener: Listener | None = None,
) -> StudyResult:
    """Computes every trial that the log does not hold yet. tell(share, text) is called after each block.

    cluster: address of a Dask scheduler, or 'local'; None: this process. listener: hears every message of the log.
    """
    tell = tell or (lambda share, text: None)
    output = study.run.config.output
    path, before = log_and_earlier(Path(output.folder), study.run.name, study.text, resume)
    with RunLog(path, "study", **origin_of(study), listener=listener, after_interruption=RESUMES) as log:
        trials = carried_over(log, before)
        found = len(trials)
        started = time.monotonic()
        for done in computed(study.plan, trials, cluster):
            log_trials(log, study.plan, [trial for trial in done if trial.number not in trials])
            trials |= {trial.number: trial for trial in done if trial.number not in trials}
            tell(*progress(len(trials), found, study.plan.trials, time.monotonic() - started))
        seconds = time.monotonic() - started
        summaries, isolation = concluded(study, trials, log)
        pictures = draw(study, trials, path)
    return StudyResult(summaries, isolation, trials, len(trials) - found, seconds, path, pictures)


def origin_of(study: Study) -> dict[str, Any]:
    """What a log says of where its study comes from."""
    resolved = study.run.resolved | {"study": study.config.model_dump(mode="json")}
    return {"config_text": study.text, "config": resolved, "seeds": {"seed": study.plan.seed}}


def log_and_earlier(folder: Path, name: str, text: str, resume: bool) -> tuple[Path, OldLog | None]:
    """Where the log is written, and with `resume` what an unfinished run of the same configuration left, if anything.

    Raises ValueError where that run has ended, or had another configuration.
    """
    found = go_on_from(folder, name, text) if resume else None
    return found or (free_path(folder, name), None)


def carried_over(log: RunLog, before: OldLog | None) -> dict[int, Trial]:
    """The trials of an earlier log, each once, copied into this one."""
    trials: dict[int, Trial] = {}
    for message in before.messages([TRIAL]) if before else ():
        fields = message.payload
        if fields["trial"] not in trials:
            numbers = {name: value for name, value in fields.items() if name not in _ENVELOPE}
            trials[fields["trial"]] = Trial(fields["trial"], fields["group"], fields["status"], numbers)
            log.carry_over([message])
    return trials


def computed(plan: Plan, known: Mapping[int, Trial], cluster: str | None) -> Iterator[list[Trial]]:
    """Blocks with a trial that is not known yet, as they get done."""
    blocks = [block for block in plan.blocks() if any(number not in known for number in block.numbers)]
    return run_blocks(plan, blocks) if cluster is None else run_on_cluster(plan, blocks, cluster)


def log_trials(log: RunLog, plan: Plan, trials: list[Trial]) -> None:
    for trial in trials:
        log.trial(
            trial.number, trial.numbers, group=trial.setting, seed=f"{plan.seed}/{trial.number}", status=trial.status
        )
    log.flush()


def progress(done: int, found: int, total: int, seconds: float) -> tuple[float, str]:
    """How far, and how long it will take at the pace so far."""
    left = seconds * (total - done) / max(done - found, 1)
    return done / total, f"{done} of {total} trials, {left:.0f} s left"


def of_setting(plan: Plan, trials: Mapping[int, Trial]) -> Iterator[list[Trial]]:
    """The trials of each setting in their order."""
    numbers: dict[int, list[int]] = {}
    for block in plan.blocks():
        numbers.setdefault(block.setting, []).extend(block.numbers)
    for chosen in numbers.values():
        yield [trials[number] for number in chosen]


def summed_up(study: Study, trials: Mapping[int, Trial]) -> Iterator[Summary]:
    for setting, own in zip(study.plan.settings, of_setting(study.plan, trials), strict=True):
        yield summarise(study.plan, setting, own, study.config.tolerance)


def isolated(study: Study, trials: Mapping[int, Trial]) -> Isolation | None:
    """Stated against true modes, where the study draws faults by mode and estimates them free of the box."""
    if study.config.faults != "modes" or "free" not in study.config.estimators:
        return None
    ordered = [trials[number] for number in sorted(trials)]
    return isolate(study.plan.fitting.space, ordered, study.run.config.estimate.confidence)


def concluded(study: Study, trials: Mapping[int, Trial], log: RunLog) -> tuple[tuple[Summary, ...], Isolation | None]:
    """What all trials together say, into the log."""
    summaries, isolation = tuple(summed_up(study, trials)), isolated(study, trials)
    for summary in summaries:
        log.summary(summary.setting, summary.trials, summary.numbers())
    if isolation is not None:
        log.result({"isolation": {name: value for name, value in vars(isolation).items() if name != "confusion"}})
        log.result_arrays(confusion=isolation.confusion)
    return summaries, isolation


def draw(study: Study, trials: Mapping[int, Trial], log: Path) -> tuple[Path, ...]:
    """Figure 3 and Table 3 of the 2020 paper as distributions, where the study varies the noise of one fault."""
    if study.config.faults != "simulated" or None in study.config.snr_db:
        return ()
    groups = list(of_setting(study.plan, trials))
    levels = [float(setting.snr_db or 0.0) for setting in study.plan.settings]
    figures = {"correlation": correlation_figure(levels, [[t.numbers["rho"] for t in own] for own in groups])}
    estimator = next((name for name in ("free", "boxed") if name in study.config.estimators), None)
    if estimator:
        errors = [[t.numbers[estimator] for t in own] for own in groups]
        truth = study.plan.settings[0].faults[0]
        bounds = [own[0].numbers["bound"] for own in groups]
        figures["estimates"] = error_figure(study.plan.fitting.space, levels, errors, truth, bounds)
    return tuple(save(figure, log.with_name(f"{log.stem}_{name}.png")) for name, figure in figures.items())
