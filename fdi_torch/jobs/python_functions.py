"""The commands as Python functions, for scripts and notebooks.

A function accepts a file (run, monitor or study file) or the same content as a mapping, in which a `Plant` may replace
the plant's name and a `Recording` the recording's file name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from fdi_torch.config.loaded_recordings import load_recordings, named_recordings, read_recording
from fdi_torch.config.monitor_file import MonitorRun, build_monitor, load_monitor
from fdi_torch.config.plant_file import AnyPlant, chosen_plant
from fdi_torch.config.problems import Source
from fdi_torch.config.run_file import Run, build_run, load_run
from fdi_torch.config.study_file import Study, build_study, load_study
from fdi_torch.effects.catalogue import Catalogue
from fdi_torch.effects.catalogue import effects as catalogue_of
from fdi_torch.estimate.misfit import misfit_of
from fdi_torch.gap.diagnose import Settings
from fdi_torch.gap.free_runs.prediction import START_SAMPLES, predicted_beside
from fdi_torch.gap.free_runs.prediction import predict as run_freely
from fdi_torch.gap.free_runs.refit import refit as refitted
from fdi_torch.gap.problem import check_holdout_differs
from fdi_torch.jobs import study as study_job
from fdi_torch.jobs import train as train_job
from fdi_torch.jobs.gap import library_entries, one_thread, run_gap
from fdi_torch.jobs.log_paths import free_path
from fdi_torch.jobs.logged_monitor import MonitorCallbacks
from fdi_torch.jobs.monitor import run_monitor
from fdi_torch.jobs.python_results import FreeRun, GapResult, MonitorResult, RefitResult
from fdi_torch.jobs.run_setup import simulate_recording
from fdi_torch.monitor.events import Event
from fdi_torch.names import unknown
from fdi_torch.plant.description import PlantDescription
from fdi_torch.progress import Tell, rounded, silent
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import doubts_about

AnyRecording = Recording | Mapping[str, Any] | str | Path
Resolved = TypeVar("Resolved")
AnyRun = Run | Mapping[str, Any] | str | Path


def _keys(run: Any, advice: str = "name its recordings as the next argument; ") -> Mapping[str, Any]:
    """The keys of a run, monitor or study file. Raises TypeError for anything but a mapping. advice: for a plant."""
    if not isinstance(run, Mapping):
        advice = advice if isinstance(run, PlantDescription) else ""
        raise TypeError(
            f"expected the name of a file, or its keys as in {{'plant': plant, ...}}, got a {type(run).__name__}; "
            f"{advice}help() of the function has an example"
        )
    return run


def _resolved(given: Any, kind: type[Resolved], load: Any, build: Any, job: str, **advice: str) -> Resolved:
    """What a file, its keys, or itself describe. job: named in messages about keys; advice: as of `_keys`."""
    if isinstance(given, str | Path):
        return load(given)
    return given if isinstance(given, kind) else build(_keys(given, **advice), Path.cwd(), Source(job))


def _run_of(run: Any, job: str) -> Run:
    """The run of a file, of its keys, or the built-in example for None."""
    return load_run() if run is None else _resolved(run, Run, load_run, build_run, job)


def _plant_and_recordings(plant: Any, recordings: Any, job: str) -> tuple[PlantDescription, list[Recording]]:
    """A plant and segments of its recordings, given apart or, without recordings, as a run."""
    if recordings is not None:
        segments = recordings_of(recordings, of := chosen_plant(plant))
        if not segments:
            raise ValueError(f"{job}: expected a recording with at least two samples, got none")
        return of, segments
    run = _run_of(plant, job)
    if run.config.simulate is not None:
        return run.plant, [simulate_recording(run)]
    loaded = load_recordings(run.config.recordings, run.plant, run.base)
    return run.plant, [part.recording for part in loaded]


def simulate(
    plant: AnyPlant | AnyRun | None = None,
    *,
    inputs: Mapping[str, Any] | None = None,
    duration: str | None = None,
    sample_time: str | None = None,
    faults: Mapping[str, float | str] | None = None,
    noise: Mapping[str, Any] | None = None,
    start_levels: Any = None,
    hold: str | None = None,
    seed: int | None = None,
) -> Recording:
    """Simulate a recording, as `fdi simulate` does.

    plant: a plant, with the keys of `simulate:` in a run file as the other arguments (None: three_tank); or, without
    any of these, a run with `simulate`: its file or its keys (None: the built-in example).
    inputs: a value or steps for every channel, {"Q1": "50 cm^3/s", "Q2": {"steps": [["0 s", "50 cm^3/s"], ...]}}.
    faults: {"T1.leak": 0.3}. noise: {"std": {"h1": "1 mm"}} or {"snr_db": 30}. The result is reproducible to the last
    bit for a given seed. Raises ConfigError, which names the wrong key and the expected value.
    """
    keys = {"inputs": inputs, "duration": duration, "sample_time": sample_time, "hold": hold, "seed": seed}
    keys |= {"start_levels": start_levels, "faults": faults, "noise": noise}
    given = {key: value for key, value in keys.items() if value is not None}
    if not given and not isinstance(plant, PlantDescription):
        return simulate_recording(_run_of(plant, "simulate"))
    if isinstance(plant, Run | Mapping):
        raise TypeError("simulate: expected either a run or a plant with the keys of simulate, got both; keep one")
    named = {} if plant is None else {"plant": plant}
    source = Source("simulate", within="simulate")  # the arguments are keys of simulate in a run file
    return simulate_recording(build_run({**named, "simulate": given}, Path.cwd(), source))


def train(
    plant: AnyPlant | AnyRun | None = None,
    recordings: AnyRecording | Sequence[AnyRecording] | None = None,
    parameters: Sequence[str] | None = None,
    *,
    tell: Tell | None = None,
    resume: bool = False,
    listener: Any = None,
    **keys: Any,
) -> train_job.TrainResult:
    """Estimate fault sizes and their uncertainty from recordings, as `fdi train` does, with a log and pictures.

    parameters: to be estimated, such as ["T1.leak"]. keys: others of a run file, such as output={"folder": "results"};
    estimate={"draws": 1000} beside the parameters. plant: without recordings, a run: its file, or its keys such as
    {"plant": plant, "recordings": [recording], "estimate": {"parameters": ["T1.leak"]}}; None: the built-in example.
    resume: continue a killed run of the same file. listener: receives every log message. tell(share, text): receives
    the progress, from 0 to 1, and a line about it; by default nothing is shown, and tell=print prints it. Raises
    ConfigError, which names the wrong key and the expected value.
    """
    run: Any = plant
    if recordings is not None:
        listed = recordings if isinstance(recordings, list | tuple) else [recordings]
        estimate = {**keys.pop("estimate", {}), **({} if parameters is None else {"parameters": parameters})}
        run = {"plant": plant, "recordings": listed, "estimate": estimate, **keys}
    elif parameters is not None or keys:
        given = ", ".join(["the parameters"] * (parameters is not None) + [*keys])
        raise TypeError(f"train: expected recordings beside {given}, got none; name them, or give a run alone")
    return train_job.train(_run_of(run, "train"), rounded(tell), resume, listener)


def gap(
    plant: AnyPlant | AnyRun,
    recordings: AnyRecording | Sequence[AnyRecording] | None = None,
    holdouts: AnyRecording | Sequence[AnyRecording] = (),
    *,
    out: str | Path = "logs",
    tell: Tell = silent,
    **settings: Any,
) -> GapResult:
    """Find where and by which effect the plant model deviates from recordings, as `fdi gap` does.

    plant, recordings: without recordings, plant is a run: its file or its keys, as of `train`.
    holdouts: recordings on which the corrected model is validated. out: folder of the log. settings: library, leave_out
    (names of effects), step (s), most, named_only, as the options of `fdi gap`. tell: as of `train`. Raises ValueError
    for other settings.
    """
    valid_settings = [field.name for field in fields(Settings)]
    for name in settings:  # first, because without recordings the plant counts as a run
        if name not in valid_settings:
            raise ValueError(f"gap: {unknown('a setting', name, [*valid_settings, 'recordings', 'holdouts', 'out'])}")
    for name in ("library", "leave_out"):
        if isinstance(settings.get(name), str):
            settings[name] = (settings[name],)
    if settings.get("library") is not None:
        settings["library"] = library_entries(settings["library"])
    plant, segments = _plant_and_recordings(plant, recordings, "gap")
    log = free_path(Path(out), "gap")
    answer = run_gap(log, plant, segments, recordings_of(holdouts, plant), Settings(**settings), rounded(tell))
    return GapResult(answer, plant, log)


def monitor(
    plant: AnyPlant | MonitorRun | Mapping[str, Any],
    recording: AnyRecording | None = None,
    *,
    tell: Tell = silent,
    **keys: Any,
) -> MonitorResult:
    """Run a monitor along a recording, as `fdi monitor` does.

    keys: those of a monitor file, such as fault_free=["0 s", "300 s"]. plant: without a recording, a monitor file or
    its keys, such as {"plant": plant, "recording": recording, "fault_free": ["0 s", "300 s"]}.
    tell: as of `train`; the progress is None along a live source. Raises ConfigError, which names the wrong key and the
    expected value.
    """
    run: Any = plant
    if recording is not None:
        run = {"plant": plant, "recording": recording, **keys}
    elif keys:
        raise TypeError(f"monitor: expected a recording beside {', '.join(keys)}, got none; name it")
    run = _resolved(run, MonitorRun, load_monitor, build_monitor, "monitor")
    events: list[Event] = []
    summary = run_monitor(run, MonitorCallbacks(rounded(tell), events.append))
    return MonitorResult(tuple(events), summary.lasted, summary.spent, summary.log)


def predict(
    plant: AnyPlant | AnyRun,
    recording: AnyRecording | None = None,
    *,
    start_samples: int = START_SAMPLES,
    step: float | None = None,
    settle: float | None = None,
    vary: Sequence[str] = (),
    tell: Tell = silent,
) -> FreeRun:
    """Simulate a plant freely along a recording and compare it with the readings, as `fdi predict` does.

    plant, recording: without a recording, plant is a run with one: its file or its keys, as of `train`.
    start_samples: number of samples for estimating the initial levels; settle: the same as a time, s. step: of the
    integration, s. vary: patterns of constants that are estimated from the start too. tell: as of `train`.
    Raises ValueError if an input is unknown for a time.
    """
    if isinstance(recording, list | tuple):
        raise TypeError(f"predict: expected one recording, got a list of {len(recording)}; call it for each of them")
    plant, parts = _plant_and_recordings(plant, recording, "predict")
    if len(parts) != 1:
        raise ValueError(
            f"{parts[0].source}: expected a recording whose inputs are known throughout, got {len(parts)} segments; "
            "cut one with Recording.known_segments()"
        )
    with one_thread():
        prediction = run_freely(plant, parts[0], start_samples, step, settle, vary, rounded(tell))
    return FreeRun(plant, parts[0], prediction)


def refit(
    plant: AnyPlant | AnyRun,
    recordings: AnyRecording | Sequence[AnyRecording] | None = None,
    holdouts: AnyRecording | Sequence[AnyRecording] = (),
    *,
    step: float | None = None,
    start_samples: int = START_SAMPLES,
    settle: float | None = None,
    tell: Tell = silent,
    **choices: Any,
) -> RefitResult:
    """Fit all constants with a tolerance and all effects of a plant to recordings, as `fdi refit` does: calibrate it.

    plant, recordings: without recordings, plant is a run: its file or its keys, as of `train`.
    holdouts: recordings that both plants predict freely, `RefitResult.trials`; start_samples, settle: as of `predict`.
    step: of the simulation, s. choices: leave_out, hold, vary (names or patterns), as the options of `fdi refit`.
    tell: as of `train`. Raises ValueError for a hold-out that is one of the recordings.
    """
    plant, segments = _plant_and_recordings(plant, recordings, "refit")
    held_out = recordings_of(holdouts, plant)
    for recording in held_out:
        check_holdout_differs(recording, segments)
    with one_thread():
        fit = refitted(plant, segments, step=step, tell=rounded(tell), **choices)
        trials = predicted_beside((plant, fit.plant), held_out, start_samples, settle=settle)
    doubts = doubts_about([*segments, *held_out], plant)
    return RefitResult(fit, misfit_of(fit.rmse, segments, plant), plant, doubts, tuple(trials))


def study(
    study: Study | Mapping[str, Any] | str | Path,
    *,
    resume: bool = False,
    cluster: str | None = None,
    tell: Tell | None = None,
) -> study_job.StudyResult:
    """Repeat an experiment many times and compare the estimates with their bounds, as `fdi study` does.

    study: a study file, or the same as a mapping. resume: continue a killed run. cluster: address of a Dask scheduler,
    or 'local'. tell: as of `train`.
    """
    given = _resolved(study, Study, load_study, build_study, "study", advice="")
    return study_job.run_study(given, resume, cluster, rounded(tell))


def effects(plant: AnyPlant | None = None) -> Catalogue:
    """The catalogue of faults and unmodelled effects, as `fdi effects` shows it.

    plant: determines places and parameter ranges; None for a generic rig with tanks of 1 m.
    """
    return catalogue_of(None if plant is None else chosen_plant(plant))


def recordings_of(wanted: AnyRecording | Sequence[AnyRecording], plant: PlantDescription) -> list[Recording]:
    """Recordings with the plant's channels, split into segments with known inputs.

    Names are read as files, and mappings as entries of a run file.
    """
    segments: list[Recording] = []
    listed: Sequence[Any] = wanted if isinstance(wanted, list | tuple) else [wanted]
    for each in listed:
        if isinstance(each, str | Path):
            segments += named_recordings(str(each), plant, Path.cwd())
            continue
        segments += [part for part in read_recording(each, plant).known_segments() if len(part) > 1]
    return segments
