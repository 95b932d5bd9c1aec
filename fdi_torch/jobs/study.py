"""The study job, trials computed locally or on a cluster, and the rehearsal job, Monte Carlo validation of a monitor
task by task: both logged and resumable.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdi_torch.config.rehearsal_file import Rehearsal
from fdi_torch.config.study_file import Study
from fdi_torch.jobs.log_paths import RESUMES, log_to_write
from fdi_torch.logbook import Listener, RunLog
from fdi_torch.logbook.reader import Run as LoggedRun
from fdi_torch.names import counted
from fdi_torch.progress import Tell, silent
from fdi_torch.report.setting_tables import setting_tables
from fdi_torch.study.cluster import run_on_cluster
from fdi_torch.study.monte_carlo import Trial, run_blocks
from fdi_torch.study.summary import Isolation, Summary, count_modes, summarise
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units

TRIAL = "/study/trial"
_ENVELOPE = ("t", "trial", "group", "seed", "status")


@dataclass(frozen=True, repr=False)
class StudyResult(Shown):
    """summaries: one per setting. isolation: of drawn modes. computed, seconds: trials of this run, and their time."""

    summaries: tuple[Summary, ...]
    isolation: Isolation | None
    trials: dict[int, Trial]
    computed: int
    seconds: float
    log: Path

    @property
    def headline(self) -> str:
        return f"{counted(len(self.trials), 'trial')} in {counted(len(self.summaries), 'setting')}"

    @in_its_units
    def tables(self, brief: bool = False) -> list[Table]:
        """The scores of each setting. brief: as `fdi study` prints them, of each estimator but the first only its worst
        parameter.
        """
        units = {score.parameter: score.unit for summary in self.summaries for score in summary.scores}
        units |= {sensor: unit for summary in self.summaries for sensor, (_, unit) in summary.noise.items()}
        return setting_tables([(s.setting, s.trials, s.numbers()) for s in self.summaries], units, brief)

    @in_its_units
    def table(self) -> Table:
        """One row per setting, estimator and parameter; bias and RMSE in the parameter's unit for display."""
        names = ("setting", "estimator", "parameter", "unit", "bias", "RMSE", "RMSE / bound", "coverage")
        rows = []
        for setting, e in ((summary.setting, score) for summary in self.summaries for score in summary.scores):
            ratios = [None if ratio is None else ratio.value for ratio in (e.over_bound, e.coverage)]
            bias = in_display_unit(e.parameter, e.unit, e.bias, e.rmse)
            rows.append((setting, e.estimator, e.parameter, *bias, *ratios))
        return Table(names, rows)


def run_study(
    study: Study,
    resume: bool = False,
    cluster: str | None = None,
    tell: Tell = silent,
    listener: Listener | None = None,
) -> StudyResult:
    """Compute every trial that the log does not have yet. tell(share, text): progress, called after each block.

    cluster: address of a Dask scheduler, or 'local'; None: this process. listener: receives every log message.
    """
    output = study.run.config.output
    path, before = log_to_write(Path(output.folder), study.run.name, study.text, resume, begin=True)
    with RunLog(path, "study", **origin_of(study), listener=listener, after_interruption=RESUMES) as log:
        trials = copied_trials(log, before)
        copied = len(trials)
        started = time.monotonic()
        blocks = [block for block in study.plan.blocks() if not trials.keys() >= set(block.numbers)]
        computed = run_blocks(study.plan, blocks) if cluster is None else run_on_cluster(study.plan, blocks, cluster)
        for done in computed:
            new = {trial.number: trial for trial in done if trial.number not in trials}
            log_trials(log, study.plan.seed, new.values())
            trials |= new
            tell(*progress(len(trials), copied, study.plan.trials, time.monotonic() - started))
        seconds = time.monotonic() - started
        summaries, isolation = log_summary(study, trials, log)
    return StudyResult(summaries, isolation, trials, len(trials) - copied, seconds, path)


def origin_of(study: Study) -> dict[str, Any]:
    """Configuration and seed of a study, as its log records them."""
    keys = study.config.model_dump(mode="json") | {"all_trials": study.plan.trials}
    resolved = study.run.resolved | {"study": keys}
    return {"config_text": study.text, "config": resolved, "seeds": {"seed": study.plan.seed}}


def copied_trials(log: RunLog, before: LoggedRun | None) -> dict[int, Trial]:
    """The trials of an earlier log, copied into this one without duplicates."""
    trials: dict[int, Trial] = {}
    for message in before.messages([TRIAL]) if before else ():
        fields = message.payload
        if fields["trial"] not in trials:
            numbers = {name: value for name, value in fields.items() if name not in _ENVELOPE}
            trials[fields["trial"]] = Trial(fields["trial"], fields["group"], fields["status"], numbers)
            log.carry_over([message])
    return trials


def log_trials(log: RunLog, seed: int, trials: Iterable[Trial]) -> None:
    for t in trials:
        log.trial(t.number, t.numbers, group=t.setting, seed=f"{seed}/{t.number}", status=t.status)
    log.flush()


def progress(done: int, copied: int, total: int, seconds: float) -> tuple[float, str]:
    """Share of completed trials, and a text with the estimated remaining time."""
    remaining = seconds * (total - done) / max(done - copied, 1)
    return done / total, f"{done} of {total} trials, {remaining:.0f} s left"


def log_summary(study: Study, trials: Mapping[int, Trial], log: RunLog) -> tuple[tuple[Summary, ...], Isolation | None]:
    """Summarise all trials, and log the summary.

    Isolated modes are compared with the true ones if faults are drawn by mode and estimated without bounds.
    """
    plan, config = study.plan, study.config
    of_setting: dict[int, list[Trial]] = {}
    for block in plan.blocks():
        of_setting.setdefault(block.setting, []).extend(trials[number] for number in block.numbers)
    summaries = tuple(summarise(plan, plan.settings[k], group, config.tolerance) for k, group in of_setting.items())
    for summary in summaries:
        log.summary(summary.setting, summary.trials, summary.numbers())
    isolation = None
    if config.faults == "modes" and "free" in config.estimators:
        ordered = [trials[number] for number in sorted(trials)]
        isolation = count_modes(plan.fitting.space, ordered, study.run.config.estimate.confidence)
        log.result({"isolation": {name: value for name, value in vars(isolation).items() if name != "confusion"}})
        log.result_arrays(confusion=isolation.confusion)
    return summaries, isolation


@dataclass(frozen=True)
class RehearsalResult:
    """tables: one per plan. tasks: all; computed: those of this run, in `seconds` s. log: path."""

    tables: tuple[Table, ...]
    tasks: int
    computed: int
    seconds: float
    log: Path


def rehearse(
    rehearsal: Rehearsal, resume: bool = False, tell: Tell = silent, listener: Listener | None = None
) -> RehearsalResult:
    """Compute every task that the log does not have yet. tell(share, text): progress, called before each task."""
    folder = Path(rehearsal.config.output.folder)
    path, before = log_to_write(folder, rehearsal.name, rehearsal.text, resume, begin=True)
    tasks = [task for plan in rehearsal.plans for task in plan.tasks()]
    records = rehearsal.log_records()
    with RunLog(path, "rehearsal", **records, listener=listener, after_interruption=RESUMES) as log:
        trials = copied_trials(log, before)
        earlier, started = len(trials), time.monotonic()
        for number, task in enumerate(tasks):
            if number not in trials:
                tell(len(trials) / len(tasks), task.group)
                numbers: dict[str, Any] = dict(task.compute())
                trials[number] = Trial(number, task.group, "done", numbers)
                log_trials(log, rehearsal.config.seed, [trials[number]])
        groups: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
        for _, trial in sorted(trials.items()):
            groups[trial.setting].append(trial.numbers)
        tables = tuple(plan.result_table(groups) for plan in rehearsal.plans)
        log.result(
            {"tables": [{"title": t.title, "header": t.header, "rows": t.rows, "said": t.summary} for t in tables]}
        )
    return RehearsalResult(tables, len(tasks), len(trials) - earlier, time.monotonic() - started, path)
