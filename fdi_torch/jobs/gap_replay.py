"""Repetition of a logged gap diagnosis from the log's recordings, plant and settings, for `fdi replay`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fdi_torch.config.logged_config import logged_gap_settings, logged_plant
from fdi_torch.gap.diagnose import ProgressCallback, Settings
from fdi_torch.jobs.gap import groups, run_gap
from fdi_torch.jobs.logged_recordings import logged_recording
from fdi_torch.logbook import Run as LoggedRun


def replay_gap(log: LoggedRun, path: Path, overrides: Iterable[str], tell: ProgressCallback, parent: str) -> None:
    """Repeat a diagnosis into the log `path`.

    overrides: changed settings, such as library=pump_lag,leak@T1, leave_out=pump_lag, step=0.5, named_only=true.
    """
    settings = settings_of(log, overrides)
    sources = [name for name in log.metadata.get("fdi_torch.data", {}) if name.endswith(".path")]
    diagnosed = int(log.metadata.get("fdi_torch.config", {}).get("recordings", 1))
    names = groups(max(len(sources) - diagnosed, 0), diagnosed)
    recordings = [logged_recording(log, group, k) for k, group in enumerate(names)]
    run_gap(path, logged_plant(log), recordings[:diagnosed], recordings[diagnosed:], settings, tell, parent)


def settings_of(log: LoggedRun, overrides: Iterable[str] = ()) -> Settings:
    """The logged settings with overrides. Raises ConfigError for an unknown key or a wrong value."""
    given = logged_gap_settings(log, overrides)
    return Settings(**given | {"library": given["library"] or None})
