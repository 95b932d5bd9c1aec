"""Fault diagnosis and sim-to-real gap diagnosis of liquid-tank plants by differentiable simulation.

The names in `__all__` are the public interface. Each is loaded on first access, so that `import fdi_torch` is instant.
Some functions share their name with the package that implements them: `fdi_torch.gap` is that package, and calling it,
`fdi_torch.gap(plant, recording)`, calls the function.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

_HOMES: dict[str, tuple[str, ...]] = {
    "fdi_torch.config.loaded_recordings": ("load_recordings", "read_frame", "read_recording"),
    "fdi_torch.recordings.csv_writing": ("write_csv",),
    "fdi_torch.config.plant_file": ("load_plant",),
    "fdi_torch.config.plant_in_code": ("Plant",),
    "fdi_torch.config.plant_writer": ("dump_plant",),
    "fdi_torch.config.problems": ("ConfigError",),
    "fdi_torch.config.run_file": ("load_run",),
    "fdi_torch.effects": ("EFFECTS", "place", "placements_for"),
    "fdi_torch.effects.catalogue": ("Catalogue",),
    "fdi_torch.estimate.fitting": ("Fitting",),
    "fdi_torch.estimate.hybrid": ("HybridResult", "estimate_parameters"),
    "fdi_torch.estimate.refinement": ("HybridSettings",),
    "fdi_torch.estimate.evolution": ("EvolutionSettings", "evolve"),
    "fdi_torch.estimate.posterior_draws": ("Draws", "draw_posterior"),
    "fdi_torch.estimate.profile": ("Profile", "profile_likelihood"),
    "fdi_torch.estimate.levenberg_marquardt": ("levenberg_marquardt",),
    "fdi_torch.jobs.fmu_export": ("export_fmu",),
    "fdi_torch.jobs.python_functions": (
        *("effects", "gap", "monitor", "predict", "refit", "simulate", "study", "train"),
    ),
    "fdi_torch.jobs.python_results": ("FreeRun", "GapResult", "MonitorResult", "RefitResult"),
    "fdi_torch.jobs.python_setup": ("build_network", "set_up"),
    "fdi_torch.jobs.report": ("ComparisonResult", "Report", "compare", "report"),
    "fdi_torch.jobs.run_setup": ("simulate_recording",),
    "fdi_torch.jobs.study": ("StudyResult",),
    "fdi_torch.jobs.train": ("TrainResult",),
    "fdi_torch.logbook": ("RunLog", "read_run"),
    "fdi_torch.parameters": ("Parameter", "ParameterSpace"),
    "fdi_torch.plant.description": ("PlacedEffect", "PlantDescription", "Sensor", "Tank"),
    "fdi_torch.plant.network": ("TankNetwork",),
    "fdi_torch.recording": ("Recording",),
    "fdi_torch.simulate.engine_choice": ("make_engine",),
    "fdi_torch.simulate.equilibrium": ("equilibrium",),
    "fdi_torch.simulate.experiment": ("Experiment", "lay_out"),
}
# A kind of flow component is a class named after its file: plant/kinds/weir.py holds Weir.
_KINDS = Path(__file__).parent / "plant" / "kinds"
_HOMES |= {f"fdi_torch.plant.kinds.{f.stem}": (f.stem.title().replace("_", ""),) for f in _KINDS.glob("[a-z]*.py")}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


class _CallableModule(ModuleType):
    # A subpackage that can be called like the public function of the same name. A docstring would hide `__doc__` below.

    @property
    def __doc__(self) -> str | None:  # type: ignore[override]
        """The function's signature and documentation: `help` of a module shows no signature otherwise."""
        import inspect  # takes a while to load

        function = self.__wrapped__
        signature = inspect.signature(function)
        names = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
        short = str(signature.replace(parameters=names, return_annotation=signature.empty))
        short = re.sub(r"<function (\w+) at \w+>", r"\1", short)  # a default
        return f"{function.__name__}{short}\n\n{inspect.getdoc(function)}"

    @property
    def __wrapped__(self) -> Callable[..., Any]:
        """The function, for `inspect.signature` and help."""
        name = self.__name__.rpartition(".")[2]
        return getattr(import_module(_HOME_OF[name]), name)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.__wrapped__(*arguments, **named)


class _Package(ModuleType):
    """Type of the module `fdi_torch`: makes a subpackage callable if a public function has its name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _HOME_OF and type(value) is ModuleType:
            value.__class__ = _CallableModule
        super().__setattr__(name, value)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("fdi_torch")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'fdi_torch' has no attribute '{name}'")
    subpackage = f"fdi_torch.{name}"
    return import_module(subpackage) if find_spec(subpackage) else getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


sys.modules[__name__].__class__ = _Package
