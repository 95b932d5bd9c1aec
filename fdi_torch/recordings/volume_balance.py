"""The volume balance of each tank along a recording, as a test of a plant's numbers without a simulation.

    A dh/dt = b_1 q_metered + b_2 q_law(h)         b_1 = b_2 = 1 for a plant that is right

Stored volume, metered flows (pumps, transfers) and flows by laws (pipes, weirs, known effects) follow from the readings
and commands. The coefficients are a least-squares estimate over sums of successive intervals; of all lengths of these
sums, the one with the smallest covariance is used. The covariance is that of GROUPS independent groups of consecutive
sums (Liang and Zeger, 1986, Biometrika 73, 13-22), plus what the tolerances of the plant's constants cause.
Combinations of the coefficients that the recording does not determine are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.special import fdtri
from torch import Tensor

from fdi_torch.effects import build_network
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.inverted_sensor import INSTANT
from fdi_torch.plant.metered_flow import MeteredFlow
from fdi_torch.plant.network import TankNetwork
from fdi_torch.plant.signals import Clock
from fdi_torch.recording import Recording

SAMPLES = 1000
"""Most samples of a thinned recording."""
GROUPS = 16
"""Groups of consecutive sums, which count as independent; each has at least two sums."""
CONFIDENCE = 0.95
DETERMINED = 1e-8
"""A combination of coefficients is determined if its share of the regressors' variance exceeds this."""


@dataclass(frozen=True)
class Volumes:
    """Volumes (B, intervals, tanks), m^3, per tank: stored, entered by metered flows, and entered by laws.

    The first of B is the plant's; the others have one constant increased by its tolerance. NaN where unknown.
    """

    stored: Tensor
    metered: Tensor
    by_laws: Tensor

    def distance(self, tank: int) -> float:
        """Distance of a tank's coefficients from one: Hotelling's T^2 over its quantile; NaN if it cannot be tested.

        The tank fulfils its balance at CONFIDENCE, jointly for all tanks, if the distance is at most 1.
        """
        terms = torch.stack([v[..., tank] for v in (self.stored, self.metered, self.by_laws)], dim=-1)
        terms = terms[:, torch.isfinite(terms).all(dim=-1).all(dim=0)]
        if terms.shape[1] < 2 * GROUPS or not bool((terms[0, :, 1:] != 0.0).any()):
            return math.nan
        sums = [_sums(terms, 2**k) for k in range(int(math.log2(terms.shape[1] / (2 * GROUPS))) + 1)]
        shortest = min(sums, key=lambda each: float(torch.logdet(_regression(each[:1]).covariance)))
        return _regression(shortest).distance(self.stored.shape[-1])


def volumes_along(plant: PlantDescription, recording: Recording) -> Volumes:
    """The volumes between samples of a recording whose inputs are known, thinned to about SAMPLES."""
    recording = recording.every(math.ceil(len(recording) / SAMPLES))
    network = build_network(plant)
    names = [n for n in plant.tolerances if not n.endswith(".start_level")]
    space = ParameterSpace([network.constants[n] for n in names])
    nominal = space.nominal()
    theta = torch.cat([nominal[None], nominal + torch.diag(space.std())])
    values = network.bind(space, theta[:, None])
    levels = _levels(network, recording, values)
    middle = [0.5 * (level[..., 1:] + level[..., :-1]) for level in levels]
    inputs = (
        recording.inputs if recording.hold == "zero_order" else 0.5 * (recording.inputs[1:] + recording.inputs[:-1])
    )
    columns = [recording.input_names.index(channel) for channel in plant.channels()]
    channels = [inputs[: len(recording) - 1, columns[channel]] for _, channel in network.actuators()]
    instant = recording.time.new_tensor(INSTANT)
    clock = Clock(recording.time[:-1], instant, instant)
    commands, _ = network.commands(channels, network.steady_command_memory(channels, clock, values), clock, values)
    point = network.operating_point(middle, commands, clock, values)
    flows = network.flows(point)
    last, net = network.last_flows(point, network.net_inflows(point, flows))
    metered = [torch.zeros_like(level) for level in middle]
    for component in plant.flow_components():
        if isinstance(component, MeteredFlow):
            network.transfer(metered, component.source, component.target, (flows | last)[component.name])
    areas = [1.0 / rate for rate in network.level_rates(point, [torch.ones_like(level) for level in middle])]
    stored = [area * torch.diff(level) for area, level in zip(areas, levels, strict=True)]
    interval = torch.diff(recording.time)
    batch = (len(theta), len(interval))
    by_laws = [interval * (total - q) for total, q in zip(net, metered, strict=True)]
    every = (stored, [interval * q for q in metered], by_laws)
    return Volumes(*(torch.stack([v.expand(batch) for v in volumes], dim=-1) for volumes in every))


def _levels(network: TankNetwork, recording: Recording, values: object) -> list[Tensor]:
    """Level of each tank (B, samples) or (samples), m; NaN without a reading."""
    unknown = torch.full_like(recording.time, math.nan)
    levels = {tank.name: unknown for tank in network.description.tanks}
    for sensor in reversed(network.description.sensors):
        if sensor.column in recording.output_names:
            i = recording.output_names.index(sensor.column)
            readings = torch.where(recording.mask[:, i], recording.outputs[:, i], unknown)
            constants = values[sensor.name]  # type: ignore[index]
            levels[sensor.tank] = (readings - constants["offset"]) / constants["gain"]
    return list(levels.values())


def _sums(terms: Tensor, length: int) -> Tensor:
    """Sums (B, GROUPS, count, 3) of `length` successive terms (B, intervals, 3)."""
    count = terms.shape[1] // length // GROUPS
    return terms[:, : GROUPS * count * length].reshape(len(terms), GROUPS, count, length, 3).sum(dim=3)


@dataclass(frozen=True)
class Regression:
    """Determined combinations of the coefficients. off (p,): their distance from those of a plant that is right.

    covariance (p, p): by the residuals. by_tolerances (B, p): changes by each tolerance.
    """

    off: Tensor
    covariance: Tensor
    by_tolerances: Tensor

    def distance(self, tests: int) -> float:
        total = self.covariance + self.by_tolerances.T @ self.by_tolerances
        statistic = self.off @ torch.linalg.lstsq(total, self.off[:, None], driver="gelsd").solution[:, 0]
        count = len(self.off)
        quantile = count * fdtri(count, GROUPS - count, 1.0 - (1.0 - CONFIDENCE) / tests)
        return float(statistic) / float(quantile)


def _regression(sums: Tensor) -> Regression:
    """Regression of the stored volume on the other two of sums (B, GROUPS, count, 3)."""
    stored, flows = sums[..., 0], sums[..., 1:]
    size = flows[0].square().mean(dim=(0, 1)).sqrt()
    scaled = flows / torch.where(size > 0.0, size, 1.0)
    shares, directions = torch.linalg.eigh(torch.einsum("gni,gnj->ij", scaled[0], scaled[0]))
    kept = directions[:, shares > DETERMINED * shares.max()]
    regressors = scaled @ kept
    normal = torch.linalg.pinv(torch.einsum("bgni,bgnj->bij", regressors, regressors), hermitian=True)
    each = torch.einsum("bij,bgnj,bgn->bi", normal, regressors, stored)
    residual = stored[0] - regressors[0] @ each[0]
    scores = torch.einsum("gni,gn->gi", regressors[0], residual) @ normal[0]
    covariance = scores.T @ scores * GROUPS / (GROUPS - kept.shape[1])
    return Regression(each[0] - size @ kept, covariance, each[1:] - each[0])
