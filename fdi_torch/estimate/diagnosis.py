"""From an estimate to words: which faults are present, how large, and whether the model explains the recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from fdi_torch.parameters import Parameter, ParameterSpace
from fdi_torch.plant.effect import Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.equilibrium import RESOLUTION

# A round hole with a sharp edge; only used to say a flow as a hole (Idelchik 1986).
HOLE_COEFFICIENT = 0.6
# Residuals this much above the sample-to-sample noise are more than noise, in standard deviations.
UNEXPLAINED_RATIO = 1.2


@dataclass(frozen=True)
class Fault:
    """One suspected fault. value, std, nominal in `unit` (SI); flow m^3/s it changes at the mean levels (None where it
    moves no water); hole: diameter in m of the sharp-edged hole that passes that flow."""

    name: str
    unit: str
    value: float
    std: float
    nominal: float
    present: bool
    probability: float
    flow: float | None
    hole: float | None


UNRELIABLE = "Unreliable: the model does not explain the recording"


@dataclass(frozen=True)
class Diagnosis:
    """faults: every suspected one, present or not. kind: 'no fault', 'single fault' or 'multiple faults'.

    confidence: that of the whole statement, shared out over the faults (Bonferroni).
    explained: whether the residuals are no larger than the readings' own sample-to-sample noise; unexplained_ratio: by
    what factor they are larger, worst channel.
    """

    faults: tuple[Fault, ...]
    confidence: float
    explained: bool
    unexplained_ratio: float

    @property
    def present(self) -> tuple[Fault, ...]:
        return tuple(f for f in self.faults if f.present)

    @property
    def kind(self) -> str:
        return ("no fault", "single fault", "multiple faults")[min(len(self.present), 2)]

    @property
    def warning(self) -> str:
        """One sentence if the model does not explain the recording, so that no size can be trusted."""
        if self.explained:
            return ""
        return f"{UNRELIABLE} (residuals {self.unexplained_ratio:.2g} times the sensors' noise)"


def diagnose(
    network: TankNetwork,
    space: ParameterSpace,
    value: Tensor,
    std: Tensor,
    mean_levels: Tensor,
    mean_channels: Tensor,
    unexplained_ratio: float,
    confidence: float = 0.95,
) -> Diagnosis:
    """value, std (P,); mean_levels (tanks,) m; mean_channels (channels,).

    A fault is present where its size differs from nominal by more than its standard error explains at the given
    confidence. A size whose standard error is infinite is never called present.
    """
    suspects = [i for i, p in enumerate(space) if is_fault_size(network, p)]
    level = 1.0 - (1.0 - confidence) / max(len(suspects), 1)
    faults = []
    for i in suspects:
        p = space.parameters[i]
        score = abs(float(value[i]) - p.nominal) / float(std[i]) if float(std[i]) > 0 else math.inf
        probability = 2.0 * NormalDist().cdf(score) - 1.0 if math.isfinite(score) else float(value[i] != p.nominal)
        flow, hole = fault_flow(network, space, value, i, mean_levels, mean_channels)
        faults.append(
            Fault(
                p.name, p.unit, float(value[i]), float(std[i]), p.nominal, probability > level, probability, flow, hole
            )
        )
    return Diagnosis(tuple(faults), confidence, unexplained_ratio <= UNEXPLAINED_RATIO, unexplained_ratio)


def is_fault_size(network: TankNetwork, parameter: Parameter) -> bool:
    """Whether the parameter is the size of an effect, not one of its shapes or a constant of the plant."""
    name = parameter.name.split("@")[0]
    for placement in network.placements:
        if name.startswith(placement.prefix + "."):
            size = placement.effect.parameters(placement.location, network.description)[0]
            return name == f"{placement.prefix}.{size.name}"
    return False


def fault_flow(
    network: TankNetwork, space: ParameterSpace, value: Tensor, which: int, levels: Tensor, channels: Tensor
) -> tuple[float | None, float | None]:
    """How much flow (m^3/s) the fault changes at these levels, and the diameter (m) of a sharp-edged hole as large."""
    name = space.names[which].split("@")[0]
    placement = next(p for p in network.placements if name.startswith(p.prefix + "."))
    if placement.effect.stage not in (Stage.FLOW, Stage.BALANCE):
        return None, None
    # Start levels of further recordings (T1.start_level@1) are no constants of the plant, and change no flow at these.
    own = [i for i, n in enumerate(space.names) if n in network.constants]
    part = ParameterSpace([network.constants[space.names[i]] for i in own])
    theta = value[own]
    without = theta.clone()
    without[own.index(which)] = space.parameters[which].nominal
    volumes = [torch.stack(_inflows(network, part, candidate, levels, channels)) for candidate in (theta, without)]
    change = (volumes[0] - volumes[1]).abs()
    flow = float(change.max())
    # Both ends of a pipe change alike but for the last bit: the hole is then one in the tank that comes first.
    head = float(levels[int((change > (1.0 - 1e-6) * flow).nonzero()[0])]) if flow > 0.0 else 0.0
    if flow <= 0.0 or head <= 0.0:
        return flow, None
    area = flow / (HOLE_COEFFICIENT * math.sqrt(2.0 * network.description.gravity * head))
    return flow, math.sqrt(4.0 * area / math.pi)


def _inflows(
    network: TankNetwork, space: ParameterSpace, theta: Tensor, levels: Tensor, channels: Tensor
) -> list[Tensor]:
    """Net inflow of each tank long after every onset, m^3/s."""
    values = network.bind(space, theta)
    late = levels.new_tensor(1e9)
    pace = time_scale(network.description)
    clock = Clock(late, levels.new_tensor(pace), levels.new_tensor(RESOLUTION * pace))
    wanted = [channels[channel] for _, channel in network.actuators()]
    commands, _ = network.commands(wanted, network.steady_command_memory(wanted, clock, values), clock, values)
    now = network.operating_point(levels.unbind(), commands, clock, values)
    return network.less_overflow(now, network.net_inflows(now, network.pump_flows(now), network.pipe_flows(now)))


def sample_noise(values: Tensor, weight: Tensor) -> Tensor:
    """The readings' noise (C,) from second differences of neighbouring samples (S, C), whatever the model.

    Differences of the second order take a smooth signal away; the median of their size is not moved by a few switches
    (Hall, Kay & Titterington 1990).
    """
    valid = (weight[2:] > 0) & (weight[1:-1] > 0) & (weight[:-2] > 0)
    second = (values[2:] - 2.0 * values[1:-1] + values[:-2]).abs() / math.sqrt(6.0)
    levels = [
        second[:, c][valid[:, c]].median() / 0.6745 if bool(valid[:, c].any()) else second.new_zeros(())
        for c in range(values.shape[1])
    ]
    return torch.stack(levels)


def lasting(residual: Tensor, weight: Tensor) -> Tensor:
    """For how many samples a residual lasts, (C,): (1 + a) / (1 - a), a its lag-1 correlation; 1 where it is white.

    Slow parameters see noise of that many times the variance (AR(1) spectrum at frequency zero; Box & Jenkins 1970).
    residual, weight: (S, C). A correlation within three standard errors of zero counts as none.
    """
    pairs = weight[1:] * weight[:-1]
    square = (weight * residual**2).sum(0) / weight.sum(0).clamp(min=1.0)
    count = pairs.sum(0).clamp(min=1.0)
    a = (pairs * residual[1:] * residual[:-1]).sum(0) / count / square.clamp(min=1e-300)
    a = torch.where(a > 3.0 / torch.sqrt(count), a, torch.zeros_like(a)).clamp(max=1.0 - 20.0 / (count + 20.0))
    return (1.0 + a) / (1.0 - a)
