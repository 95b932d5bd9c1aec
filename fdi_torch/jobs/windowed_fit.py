"""Fit of short windows of a recording, one by one, which shows when a temporary fault was present.

`estimate.windows` of a run file requests it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from fdi_torch.config.loaded_recordings import LoadedRecording
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import StartLevel
from fdi_torch.config.run_file import Run
from fdi_torch.effects import without_startup_effects
from fdi_torch.estimate.windows import Stretch, Window, cut_up, noise_of, stretches_of, window_of, window_step
from fdi_torch.jobs.log_paths import STARTS_OVER, free_path
from fdi_torch.jobs.run_setup import fitting_of, hybrid_settings, recordings_of, requested_space
from fdi_torch.jobs.train import log_recordings
from fdi_torch.logbook import RunLog
from fdi_torch.parameters import is_effect_parameter
from fdi_torch.progress import Tell, silent
from fdi_torch.recordings.check import doubts_about


@dataclass(frozen=True)
class WindowedFit:
    """windows: fitted windows. stretches: periods in which each fault was present. step: of the integration, s.

    doubts: what limits the trust in the recordings, one sentence each.
    """

    windows: tuple[Window, ...]
    stretches: tuple[Stretch, ...]
    step: float
    log: Path
    doubts: tuple[str, ...]


def fit_windows(run: Run, tell: Tell = silent) -> WindowedFit:
    """Cut the recordings of a run file into windows of `estimate.windows` s, and fit the suspected faults in each.

    The initial levels of each window are free, and constants to calibrate have their tolerances as priors in each
    window. Effects of the plant that act only at the start of a run are left out, because windows start in mid-run.
    """
    run = replace(run, plant=without_startup_effects(run.plant, run.plant.channels()))
    if run.config.device != "cpu":
        place = run.source.at("device")
        raise ConfigError([f"{place}: expected cpu with estimate.windows, got {run.config.device}; leave it out"])
    length = run.config.estimate.windows
    assert length is not None
    loaded = recordings_of(run)
    space = requested_space(run)
    suspects = {p.name for p in space if is_effect_parameter(p.name)}
    free: dict[str, StartLevel] = dict.fromkeys((t.name for t in run.plant.tanks), "free")
    path = free_path(Path(run.config.output.folder), run.name)
    records = run.log_records(part.recording.origin for part in loaded)
    with RunLog(path, "train", **records, after_interruption=STARTS_OVER) as log:
        log_recordings(log, loaded, {})
        noise = [noise_of(part.recording, run.plant) for part in loaded]
        cuts = [(c, std) for part, std in zip(loaded, noise, strict=True) for c in cut_up(part.recording, length)]
        if not cuts:
            place = run.source.at("estimate.windows")
            raise ConfigError([f"{place}: expected windows shorter than a recording, got {length:g} s; shorten them"])
        fittings = [fitting_of(run, space, [LoadedRecording(cut, free)]) for cut, _ in cuts]
        step = hybrid_settings(run.config.estimate).refine_step or window_step(fittings, noise[0])
        windows = []
        for k, (fitting, (cut, std)) in enumerate(zip(fittings, cuts, strict=True)):
            tell(k / len(cuts), f"window at {float(cut.time[0]):g} s")
            windows.append(window_of(fitting, std, suspects, step))
        doubts = doubts_about([part.recording for part in loaded], run.plant)
        result = WindowedFit(tuple(windows), tuple(stretches_of(windows)), step, path, doubts)
        fields = [
            {"start": w.start, "stop": w.stop, "misfit": w.misfit}
            | {f.name: {"size": f.size, "std": f.std, "state": f.state} for f in w.faults}
            for w in windows
        ]
        stretches = [vars(s) for s in result.stretches]
        log.result({"step": step, "doubts": list(doubts), "windows": fields, "stretches": stretches})
    tell(1.0, "done")
    return result
