"""Fault diagnosis and sim-to-real gap diagnosis of liquid-tank plants by differentiable simulation.

The names below are the public interface; each is loaded when first asked for, so that `import fdi_torch` is instant.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "fdi_torch.config": ("dump_plant", "load_plant", "load_recordings", "load_run", "read_recording"),
    "fdi_torch.effects": ("EFFECTS", "build_network", "place", "placements_for"),
    "fdi_torch.estimate.fitting": ("Fitting", "set_up"),
    "fdi_torch.estimate.hybrid": ("HybridResult", "HybridSettings", "estimate_parameters"),
    "fdi_torch.estimate.evolution": ("EvolutionSettings", "evolve"),
    "fdi_torch.estimate.refine": ("levenberg_marquardt",),
    "fdi_torch.logbook": ("RunLog", "read_run"),
    "fdi_torch.jobs.train": ("train",),
    "fdi_torch.jobs.run_setup": ("simulate_recording",),
    "fdi_torch.parameters": ("Parameter", "ParameterSpace"),
    "fdi_torch.plant.description": ("PlantDescription",),
    "fdi_torch.plant.network": ("TankNetwork",),
    "fdi_torch.recording": ("Recording",),
    "fdi_torch.simulate.choose": ("make_engine",),
    "fdi_torch.simulate.equilibrium": ("equilibrium",),
    "fdi_torch.simulate.experiment": ("Experiment", "lay_out"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'fdi_torch' has no attribute '{name}'")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return list(__all__)
