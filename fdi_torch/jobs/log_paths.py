"""Which log a job writes: one under a free name, or that of a killed run, from which it goes on."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import torch

from fdi_torch.config.run import Run
from fdi_torch.estimate.evolution import Search
from fdi_torch.logbook import Message, last_state, unfinished

# What a resumed run takes over from the log of the killed one.
KEPT = ("/plant/input", "/plant/output", "/plant/truth", "/estimator/de/generation", "/estimator/de/population")


def free_path(folder: Path, name: str, ending: str = "mcap") -> Path:
    """NAME.mcap in the folder, or NAME_2.mcap, NAME_3.mcap ... where that is taken."""
    for k in count(1):
        path = folder / (f"{name}.{ending}" if k == 1 else f"{name}_{k}.{ending}")
        if not path.exists() and not path.with_name(path.name + ".partial").exists():
            return path
    raise AssertionError("unreachable")


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
