"""Choice of the simulation engine, with the reason as a sentence."""

from __future__ import annotations

from dataclasses import replace

import torch

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import length_scale, time_scale
from fdi_torch.simulate.build import BuildError
from fdi_torch.simulate.compiled_engine import CompiledEngine
from fdi_torch.simulate.engine import Engine
from fdi_torch.simulate.experiment import Experiment
from fdi_torch.simulate.reference_engine import ReferenceEngine
from fdi_torch.simulate.traced_engine import TracedEngine

KINDS = ("auto", "compiled", "traced", "reference")


def make_engine(
    network: TankNetwork, space: ParameterSpace, experiment: Experiment, kind: str = "auto", device: str = "cpu"
) -> Engine:
    """The requested engine, or under 'auto' the fastest one; `engine.why` states the reason.

    Raises ValueError for an unknown kind, or for 'compiled' on another device than the CPU, and BuildError if
    'compiled' is requested without a compiler.
    """
    if kind not in KINDS:
        raise ValueError(f"expected an engine of {', '.join(KINDS)}, got '{kind}'")
    if kind == "reference":
        return ReferenceEngine(network, space, experiment, why="reference engine (torchdiffeq): asked for")
    if kind == "traced":
        return TracedEngine(network, space, experiment, "traced engine (torch): asked for")
    runs_on = torch.device(device).type
    if kind == "compiled" and runs_on != "cpu":
        raise ValueError(f"engine: expected auto, traced or reference on {device}, got compiled, which runs on the CPU")
    if runs_on != "cpu":
        return TracedEngine(network, space, experiment, f"traced engine (torch): runs on {runs_on}")
    engine = CompiledEngine(network, space, experiment, "compiled engine: asked for")
    try:
        engine.prepare()
    except BuildError as error:
        if kind == "compiled":
            raise
        return TracedEngine(network, space, experiment, f"traced engine (torch): {error}")
    if kind == "auto":
        threads = torch.get_num_threads()
        engine.why = f"compiled engine on {threads} processor core{'s' if threads > 1 else ''}"
    return engine


def adaptive_engine(network: TankNetwork, space: ParameterSpace, experiment: Experiment, step: float) -> Engine:
    """The reference engine with an adaptive solver about as accurate as RK4 with steps of `step` s.

    Square roots and rims have the same smoothing as with those steps. For a few lanes this is much cheaper than so many
    fixed steps in Python.
    """
    smoothed = replace(experiment, resolution=torch.full_like(experiment.resolution, step))
    plant = network.description
    rtol = 2.5e-6 * (step / time_scale(plant)) ** 2
    atol = 0.01 * rtol * length_scale(plant)
    why = f"reference engine (torchdiffeq, dopri5 at {rtol:.0e}): asked for"
    return ReferenceEngine(network, space, smoothed, "dopri5", rtol, atol, why, every_node=False)
