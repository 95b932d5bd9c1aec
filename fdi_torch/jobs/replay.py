"""Repetition of a logged run from the log's recordings and settings, for `fdi replay`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fdi_torch.config.loaded_recordings import LoadedRecording, start_levels_of
from fdi_torch.config.logged_config import logged_gap_settings, logged_mapping, logged_plant
from fdi_torch.config.monitor_file import build_monitor
from fdi_torch.config.problems import Source
from fdi_torch.config.run_file import Run, build_run
from fdi_torch.config.study_file import build_study
from fdi_torch.config.yaml_files import with_overrides
from fdi_torch.jobs import study as study_job
from fdi_torch.jobs.gap import groups, run_gap
from fdi_torch.jobs.logged_monitor import LoggedMonitor, MonitorCallbacks
from fdi_torch.jobs.logged_recordings import logged_recording
from fdi_torch.jobs.monitor_rows import fault_free_recording, logged_items, rows_in
from fdi_torch.jobs.run_setup import fitting_of, requested_space
from fdi_torch.jobs.study import TRIAL, log_summary, log_trials
from fdi_torch.jobs.train import STATE, estimate_logged, log_recordings, state_is_due
from fdi_torch.logbook import LogError, Message, RunLog, series
from fdi_torch.logbook import Run as LoggedRun
from fdi_torch.logbook.replay import Select
from fdi_torch.logbook.signals import recording_groups
from fdi_torch.progress import Tell, silent
from fdi_torch.study.monte_carlo import Trial, run_blocks

# A replay uses the log's data, so configuration keys of the data cannot be changed.
_DATA_KEYS = ("simulate", "recordings")


def repeat_run(
    log: LoggedRun, path: Path, overrides: Iterable[str] = (), trials: Sequence[int] = (), tell: Tell = silent
) -> Path:
    """Repeat the run of a log of `fdi train`, `fdi study`, `fdi gap` or `fdi monitor`, and log it at `path`.

    Returns the new log's path. trials: of a study, only these; by default all logged ones. Raises LogError for other
    logs, ConfigError for an invalid configuration, ValueError for overrides of the data and for unknown trials.
    """
    about = log.about("run")
    kind, parent = about.get("kind", ""), about.get("run_id", "")
    if trials and kind != "study":
        raise ValueError(f"--trial: expected a study's log, got one of fdi {kind}: {log.path}; leave --trial out")
    replays: dict[str, Callable[[LoggedRun, Path, Sequence[str], Tell, str], None]] = {
        "train": replay_estimate,
        "study": partial(replay_study, trials=trials),
        "gap": replay_gap,
        "monitor": replay_monitor,
    }
    if kind not in replays:
        wanted = "fdi train, fdi study, fdi gap or fdi monitor"
        raise LogError(f"{log.path}: expected a log of {wanted}, got one of {kind or 'another program'}")
    replays[kind](log, path, list(overrides), tell, parent)
    return path


def replay_estimate(log: LoggedRun, path: Path, overrides: Sequence[str], tell: Tell, parent: str) -> None:
    """Repeat an estimation from the recordings in the log."""
    run = logged_run(log, overrides)
    if run.config.estimate.windows is not None:
        raise LogError(
            f"{log.path}: expected a fit of whole recordings, got one window by window, which has no events to "
            "compare; repeat it with fdi train"
        )
    space, loaded = requested_space(run), logged_recordings(log, run)
    fitting = fitting_of(run, space, loaded)
    records = run.log_records(part.recording.origin for part in loaded)
    true_faults = {
        name: float(values[0]) for name, values in series(log, "/plant/truth").items() if name != "t" and len(values)
    }
    with RunLog(path, "train", **records, parent_run_id=parent) as again:
        log_recordings(again, loaded, true_faults)
        estimate_logged(run, fitting, again, tell)


def replay_monitor(log: LoggedRun, path: Path, overrides: Sequence[str], tell: Tell, parent: str) -> None:
    """Repeat a monitor run along the samples in the log."""
    _expect_no_data(overrides, ("recording",))
    run = build_monitor(*_logged_values(log, overrides))
    items = logged_items(log, run)
    about = log.about("data")
    data = [{"path": about["0.path"], "sha256": about.get("0.sha256", "")}] if "0.path" in about else []
    with RunLog(path, "monitor", **run.log_records(data), parent_run_id=parent) as again:
        monitor = LoggedMonitor(run, again, MonitorCallbacks(tell))
        monitor.learn(fault_free_recording(rows_in(items), run))
        monitor.process_items(items)
        monitor.close()
        again.result({"events": monitor.events, "faults": monitor.faults()})


def replay_study(
    log: LoggedRun, path: Path, overrides: Sequence[str], tell: Tell, parent: str, *, trials: Sequence[int]
) -> None:
    """Repeat trials of a study, and its summary if all trials are repeated."""
    study = build_study(*_logged_values(log, overrides))
    logged = range(study.plan.trials) if overrides else (m.payload["trial"] for m in log.messages([TRIAL]))
    numbers = sorted(set(trials or logged))
    done: dict[int, Trial] = {}
    with RunLog(path, "study", **study_job.origin_of(study), parent_run_id=parent) as again:
        for block in run_blocks(study.plan, study.plan.blocks_of(numbers)):
            log_trials(again, study.plan.seed, block)
            done |= {trial.number: trial for trial in block}
            tell(len(done) / len(numbers), f"{len(done)} of {len(numbers)} trials")
        if len(done) == study.plan.trials:
            log_summary(study, done, again)


def comparable(trials: Sequence[int] = ()) -> Select:
    """Selection of the events of a log that are compared with its replay.

    A study's trials are sorted by number, followed by its summary. Search states are compared only where the present
    version logs them; older versions logged more.
    """

    def select(messages: Iterable[Message]) -> Iterator[Message]:
        waiting: list[Message] = []
        for message in messages:
            if message.topic.startswith("/estimate/") and message.topic.endswith(("/output", "/residual")):
                continue  # follow from estimate and recording, which are compared; older logs lack them
            if message.topic == STATE and not state_is_due(message.payload["generation"]):
                continue
            if message.topic != TRIAL:
                yield from sorted(waiting, key=lambda m: m.payload["trial"])
                waiting = []
                if not trials:
                    yield message
            elif not trials or message.payload["trial"] in trials:
                waiting.append(message)
        yield from sorted(waiting, key=lambda m: m.payload["trial"])

    return select


def logged_run(log: LoggedRun, overrides: Iterable[str] = ()) -> Run:
    """The run as its log describes it, with overrides."""
    overrides = list(overrides)
    _expect_no_data(overrides, _DATA_KEYS)
    return build_run(*_logged_values(log, overrides))


def _logged_values(log: LoggedRun, overrides: Sequence[str]) -> tuple[dict[str, Any], Path, Source]:
    """The mapping of a log's configuration with overrides, the log's folder, and both."""
    return with_overrides(logged_mapping(log), overrides), log.path.parent, Source(str(log.path), tuple(overrides))


def _expect_no_data(overrides: Iterable[str], keys: Sequence[str]) -> None:
    for override in overrides:
        if override.split("=")[0].split(".")[0] in keys:
            raise ValueError(
                f"--set {override}: expected a key other than those of the data; to change the data, use fdi train or "
                "fdi monitor"
            )


def logged_recordings(log: LoggedRun, run: Run) -> list[LoadedRecording]:
    """The recordings in a log, with the configured knowledge of their initial levels."""
    groups = recording_groups(message.topic for message in log.messages())
    levels = _start_levels(run, len(groups), log.path)
    return [
        LoadedRecording(logged_recording(log, group, k), level)
        for k, (group, level) in enumerate(zip(groups, levels, strict=True))
    ]


def _start_levels(run: Run, count: int, path: Path) -> list[Any]:
    """Configured initial levels of each recording."""
    if run.config.simulate is not None:
        return [run.config.simulate.start_levels] * count
    if count != len(run.config.recordings):
        raise LogError(
            f"{path}: expected {len(run.config.recordings)} recordings, got {count}; "
            "the log is incomplete and cannot be replayed"
        )
    return [start_levels_of(recording.start_levels, run.plant, recording) for recording in run.config.recordings]


def replay_gap(log: LoggedRun, path: Path, overrides: Sequence[str], tell: Tell, parent: str) -> None:
    """Repeat a diagnosis into the log `path`.

    overrides: changed settings, such as library=pump_lag,leak@T1, leave_out=pump_lag, step=0.5, named_only=true.
    """
    settings = logged_gap_settings(log, overrides)
    sources = [name for name in log.about("data") if name.endswith(".path")]
    diagnosed = int(log.about("config").get("recordings", 1))
    names = groups(max(len(sources) - diagnosed, 0), diagnosed)
    recordings = [logged_recording(log, group, k) for k, group in enumerate(names)]
    run_gap(path, logged_plant(log), recordings[:diagnosed], recordings[diagnosed:], settings, tell, parent)
