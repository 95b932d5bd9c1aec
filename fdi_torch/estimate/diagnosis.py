"""Diagnosis from an estimate: which faults are present, how large they are, and whether the model fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from fdi_torch.amounts import estimate_words, parameter_words, sized_words
from fdi_torch.estimate.combinations import Combination
from fdi_torch.estimate.joint_fault_test import rival_faults
from fdi_torch.estimate.linearisation import Linearise
from fdi_torch.estimate.misfit import Misfit, fault_statement, kind_of
from fdi_torch.estimate.rival_faults import RivalFaults
from fdi_torch.parameters import Parameter, ParameterName, ParameterSpace, common_name
from fdi_torch.plant.effect import Stage
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.scales import time_scale
from fdi_torch.plant.signals import Clock
from fdi_torch.simulate.equilibrium import RESOLUTION

# Discharge coefficient of a sharp-edged round hole (Idelchik 1986), for converting a flow into an equivalent hole.
HOLE_COEFFICIENT = 0.6


@dataclass(frozen=True)
class Fault:
    """Test result for one suspected fault.

    value, std, nominal: in `unit` (SI). probability: confidence level at which the value differs from nominal.
    flow: change of flow at the mean levels, m^3/s; None if the fault does not change a flow. hole: diameter of the
    sharp-edged hole that passes this flow, m.
    """

    name: str
    unit: str
    value: float
    std: float
    nominal: float
    present: bool
    probability: float
    flow: float | None
    hole: float | None


@dataclass(frozen=True)
class Diagnosis:
    """Test results for all suspected faults, valid only if the model explains the recording.

    faults: all suspected faults, present or not. not_isolated: combinations of fault sizes, none of them determined
    alone, that deviate significantly from nominal, so that at least one of their faults is present. rivals: other
    faults, none of them significant alone, of which at least one is present.
    confidence: joint confidence of all statements (Bonferroni correction).
    """

    faults: tuple[Fault, ...]
    confidence: float
    misfit: Misfit
    not_isolated: tuple[Combination, ...] = ()
    rivals: RivalFaults | None = None

    @property
    def groups(self) -> tuple[Combination | RivalFaults, ...]:
        """The groups of faults of which at least one is present, not isolated from each other."""
        return (*self.not_isolated, *([self.rivals] if self.rivals else []))

    @property
    def present(self) -> tuple[Fault, ...]:
        return tuple(f for f in self.faults if f.present)

    @property
    def claims(self) -> bool:
        """Whether at least one fault differs significantly from nominal, alone or together with others."""
        return bool(self.present or self.groups)

    @property
    def kind(self) -> str:
        """'no fault', 'single fault', 'fault not isolated' or 'multiple faults'; 'not established' if the model does
        not explain the recording, because every test of a fault size assumes that it does.
        """
        return kind_of(len(self.present), len(self.groups), self.misfit.explained)

    @property
    def statement(self) -> str:
        """Kind and names of the faults present: 'multiple faults: leak at T1, leak at T2 or plugging at OUT2'."""
        names = [parameter_words(f.name) for f in self.present]
        return fault_statement(names, [g.rivals for g in self.groups], self.misfit.explained)

    @property
    def headline(self) -> str:
        """Kind and sizes, such as 'single fault: leak at T1 (size 0.3000 ± 0.0020)'.

        It begins with a warning if the model does not explain the recording.
        """
        sizes = [sized_words(f.name, [estimate_words(f.name, f.unit, f.value, f.std)]) for f in self.present]
        not_isolated = [g.sized_rivals for g in self.groups]
        return self.misfit.headline(fault_statement(sizes, not_isolated, self.misfit.explained))


def diagnose(
    network: TankNetwork,
    space: ParameterSpace,
    value: Tensor,
    std: Tensor,
    mean_levels: Tensor,
    mean_channels: Tensor,
    misfit: Misfit,
    confidence: float = 0.95,
    combinations: Sequence[Combination] = (),
    linearise: Linearise | None = None,
) -> Diagnosis:
    """Test each fault size for a significant deviation from nominal, then the remaining ones together.

    A fault is present if |value - nominal| / std is significant at `confidence`, two-sided and Bonferroni-corrected for
    the number of tests: one of each fault and, of several faults, a joint one. A fault with an infinite standard error
    is never present; combinations: what is determined of such faults, tested in the same way.
    linearise: of the negative log-likelihood, for the joint test; None omits it.
    value, std (P,): estimates and standard errors. mean_levels (tanks,), m; mean_channels (channels,): actuator inputs.
    """
    fault_sizes = [i for i, p in enumerate(space) if is_fault_size(network, p)]
    tests = len(fault_sizes) + (len(fault_sizes) > 1)
    level = 1.0 - (1.0 - confidence) / max(tests, 1)
    faults = []
    for i in fault_sizes:
        p = space.parameters[i]
        probability = probability_of_deviation(float(value[i]), float(std[i]), p.nominal)
        flow, hole = fault_flow(network, space, value, i, mean_levels, mean_channels)
        faults.append(
            Fault(
                p.name, p.unit, float(value[i]), float(std[i]), p.nominal, probability > level, probability, flow, hole
            )
        )
    sizes = {space.names[i] for i in fault_sizes}
    not_isolated = tuple(
        c
        for c in combinations
        if sizes.issuperset(c.parameters) and probability_of_deviation(c.value, c.std, c.nominal) > level
    )
    decided = {f.name for f in faults if f.present} | {name for c in not_isolated for name in c.parameters}
    undecided = [i for i in fault_sizes if space.names[i] not in decided]
    rivals = rival_faults(linearise, space, value, undecided, level) if linearise and len(undecided) > 1 else None
    return Diagnosis(tuple(faults), confidence, misfit, not_isolated, rivals)


def probability_of_deviation(value: float, std: float, nominal: float) -> float:
    """Confidence level at which an estimate differs from its nominal value, two-sided."""
    if not std > 0:
        return float(value != nominal)
    return 2.0 * NormalDist().cdf(abs(value - nominal) / std) - 1.0


def is_fault_size(network: TankNetwork, parameter: Parameter) -> bool:
    """Whether the parameter is the size of a suspected effect, as opposed to a shape parameter or a constant of the
    plant. A known effect whose size has a tolerance is a constant.
    """
    if math.isfinite(parameter.std):
        return False
    name = common_name(parameter.name)
    for placement in network.placements:
        if ParameterName.parse(name).prefix == placement.prefix:
            size = placement.effect.parameters(placement.location, network.description)[0]
            return name == placement.full_name(size.name)
    return False


def fault_flow(
    network: TankNetwork, space: ParameterSpace, value: Tensor, which: int, levels: Tensor, channels: Tensor
) -> tuple[float | None, float | None]:
    """Change of flow (m^3/s) that a fault causes, and the diameter (m) of the sharp-edged hole with the same flow.

    The change is the largest difference of any tank's net inflow between the value and the nominal value of the fault.
    From Torricelli's law, flow = HOLE_COEFFICIENT * area * sqrt(2 g level). None where undefined; only a fault of a
    tank has a hole.
    which: index of the fault in `space`. levels (tanks,), m; channels (channels,): actuator inputs.
    """
    name = common_name(space.names[which])
    placement = next(p for p in network.placements if ParameterName.parse(name).prefix == p.prefix)
    if placement.effect.stage not in (Stage.FLOW, Stage.BALANCE):
        return None, None
    # Initial levels of further recordings (T1.start_level@1) are not plant constants and do not affect these flows.
    plant_columns = [i for i, n in enumerate(space.names) if n in network.constants]
    plant_space = ParameterSpace([network.constants[space.names[i]] for i in plant_columns])
    theta = value[plant_columns]
    without = theta.clone()
    without[plant_columns.index(which)] = space.parameters[which].nominal
    inflows = [
        torch.stack(_inflows(network, plant_space, parameters, levels, channels)) for parameters in (theta, without)
    ]
    change = (inflows[0] - inflows[1]).abs()
    flow = float(change.max())
    head = float(levels[change.argmax()])
    if placement.location not in {tank.name for tank in network.description.tanks} or flow <= 0.0 or head <= 0.0:
        return flow, None
    area = flow / (HOLE_COEFFICIENT * math.sqrt(2.0 * network.description.gravity * head))
    return flow, math.sqrt(4.0 * area / math.pi)


def _inflows(
    network: TankNetwork, space: ParameterSpace, theta: Tensor, levels: Tensor, channels: Tensor
) -> list[Tensor]:
    """Net inflow of each tank, m^3/s, at a time long after every fault onset."""
    values = network.bind(space, theta)
    late = levels.new_tensor(1e9)
    time_constant = time_scale(network.description)
    clock = Clock(late, levels.new_tensor(time_constant), levels.new_tensor(RESOLUTION * time_constant))
    inputs = [channels[channel] for _, channel in network.actuators()]
    commands, _ = network.commands(inputs, network.steady_command_memory(inputs, clock, values), clock, values)
    point = network.operating_point(levels.unbind(), commands, clock, values)
    return network.less_overflow(point, network.net_inflows(point, network.flows(point)))
