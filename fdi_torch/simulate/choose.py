"""Which engine to use for the work ahead, and why, in a sentence that can be shown."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled import CompiledEngine
from fdi_torch.simulate.engine import Engine
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.integrate import ReferenceEngine
from fdi_torch.simulate.traced import TracedEngine

Kind = Literal["auto", "compiled", "traced", "reference"]
KINDS = ("auto", "compiled", "traced", "reference")

# Time steps (as many as the experiment has, a simulation each) that torch alone runs in about the time that a
# compiler takes: it runs some 2000 a second, however many lanes each has.
_WORTH_COMPILING = 2000


def make_engine(
    network: TankNetwork,
    space: ParameterSpace,
    experiment: Experiment,
    kind: str = "auto",
    simulations: float = float("inf"),
    device: str = "cpu",
) -> Engine:
    """The engine asked for, or under 'auto' the fastest for about `simulations` calls; `engine.why` says why.

    Raises ValueError for an unknown kind, BuildError where 'compiled' is asked for and there is no compiler.
    """
    if kind not in KINDS:
        raise ValueError(f"expected an engine of {', '.join(KINDS)}, got '{kind}'")
    if kind == "reference":
        return ReferenceEngine(network, space, experiment, why="reference engine (torchdiffeq): asked for")
    if kind == "traced":
        return TracedEngine(network, space, experiment, "traced engine (torch): asked for")
    engine = CompiledEngine(network, space, experiment, "compiled engine: asked for")
    if kind == "compiled":
        engine.prepare()
        return engine
    return _fastest(engine, simulations, torch.device(device).type)


def adaptive_engine(network: TankNetwork, space: ParameterSpace, experiment: Experiment, step: float) -> Engine:
    """The reference engine by an adaptive solver, about as exact as RK4 in steps of `step` s, roots drawn as sharply.

    For a few lanes it is far cheaper than so many steps in Python would be.
    """
    drawn = replace(experiment, resolution=torch.full_like(experiment.resolution, step))
    plant = network.description
    rtol = 2.5e-6 * (step / time_scale(plant)) ** 2
    atol = 0.01 * rtol * length_scale(plant)
    why = f"reference engine (torchdiffeq, dopri5 at {rtol:.0e}): asked for"
    return ReferenceEngine(network, space, drawn, "dopri5", rtol, atol, why, every_node=False)


def _fastest(compiled: CompiledEngine, simulations: float, device: str) -> Engine:
    parts = (compiled.network, compiled.space, compiled.experiment)
    if device != "cpu":
        return TracedEngine(*parts, f"traced engine (torch): runs on {device}")
    if not compiled.is_built() and simulations * len(compiled.experiment.steps) < _WORTH_COMPILING:
        return TracedEngine(*parts, "traced engine (torch): too little work to compile for")
    try:
        compiled.prepare()
    except BuildError as error:
        return TracedEngine(*parts, f"traced engine (torch): {error}")
    compiled.why = f"compiled engine: {torch.get_num_threads()} thread(s)"
    return compiled
