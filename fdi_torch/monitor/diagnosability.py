"""Diagnosability of an experiment: which faults are detectable and isolable, and their smallest sizes.

Definitions 1 to 3 and Theorem 1 of the 2020 paper, from the sensitivities of the readings to the faults.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import torch
from torch import Tensor

from fdi_torch.amounts import parameter_words
from fdi_torch.effects import placements_for
from fdi_torch.estimate.combinations import undetermined_groups
from fdi_torch.estimate.fitting import StartLevels, set_up
from fdi_torch.estimate.information import certainty, fisher_information
from fdi_torch.estimate.uncertainty import plain_value
from fdi_torch.monitor.structural_analysis import structure_of
from fdi_torch.names import listed
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import Pipe, PlantDescription, Tank
from fdi_torch.recording import Recording

# Signatures are identical if the sine of their angle is below this.
SAME = 1e-6
ROUNDING = 1e-9  # a projected signature below this share of the original counts as zero
CONSTANT = 1e-9  # a reading whose range is below this share of its magnitude is constant
STEP = 0.25
FALSE_ALARM, MISS = 0.001, 0.05  # error rates that define the smallest sizes
REACH = NormalDist().inv_cdf(1.0 - 0.5 * FALSE_ALARM) + NormalDist().inv_cdf(1.0 - MISS)
"""Size that is detected with these error rates, in standard deviations."""


@dataclass(frozen=True)
class Diagnosability:
    """Diagnosability of F faults (names, units) with C sensors, for one experiment and noise level.

    shows (F, C): norm over the samples of the effect of a unit fault on a sensor, in noise standard deviations. apart
    (F, F): sine of the angle between two signatures; 0: not separable. structurally_apart: structural isolability.
    rank: number of determined combinations of faults. std (F): Cramer-Rao bound if all are estimated together; infinite
    if not determined. std_by_correlation: the same if gain and offset of each channel are free, as for a correlation.
    smallest_detectable (F): size detected with the given error rates if time and kind are known; infinite beyond the
    fault's range. smallest_isolable (F): size that is distinguished from any other single fault. groups: faults that
    cannot be distinguished, and why.
    """

    faults: tuple[str, ...]
    units: tuple[str, ...]
    sensors: tuple[str, ...]
    shows: tuple[tuple[float, ...], ...]
    apart: tuple[tuple[float, ...], ...]
    structurally_apart: tuple[tuple[bool, ...], ...]
    rank: int
    std: tuple[float, ...]
    std_by_correlation: tuple[float, ...]
    smallest_detectable: tuple[float, ...]
    smallest_isolable: tuple[float, ...]
    groups: tuple[str, ...]
    remarks: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; infinite values become None."""
        return {key: plain_value(value, key) for key, value in asdict(self).items()}


def diagnosability(
    plant: PlantDescription,
    faults: Sequence[str],
    recording: Recording,
    noise_std: Tensor,
    at: dict[str, float] | None = None,
    calibrate: Sequence[str] = (),
    start: StartLevels = "equilibrium",
    step: float = STEP,
) -> Diagnosability:
    """Diagnosability for the inputs and sample times of a recording; its readings are not used.

    faults: parameters such as 'T1.leak.size'. noise_std (C,) in the sensors' units. at: values at which to linearise,
    nominal by default. calibrate: constants that are uncertain by their tolerances. Raises ValueError.
    """
    if not faults:
        raise ValueError("expected at least one fault, got none; name some, such as T1.leak.size")
    fitting = set_up(plant, [recording], [*faults, *calibrate], start)
    theta = fitting.space.vector(at or {})
    readings, slopes = fitting.engines(step)[0].linearise(theta)
    count, prior, unit_noise = len(faults), torch.diag(fitting.space.std(theta) ** -2), torch.ones_like(noise_std)
    scaled = slopes / noise_std[:, None]
    joint, correlation_certainty = (
        certainty(fisher_information(shown, unit_noise) + prior)
        for shown in (scaled, without_gain_and_offset(scaled, readings))
    )
    signatures = without_constants(scaled, count, fitting.space.std(theta))
    apart = sines(signatures)
    length = torch.linalg.vector_norm(signatures, dim=0)
    structural = structure_of(plant, placements_for(faults)).isolable()
    prefixes = [ParameterName.parse(name).prefix for name in faults]
    nominal, low, high = (
        each(theta)[:count] for each in (fitting.space.nominal, fitting.space.low, fitting.space.high)
    )
    largest = torch.maximum(high - nominal, nominal - low)
    detectable = _limits(length, length, largest)
    shown = detectable < torch.inf
    itself_or_hidden = torch.eye(count, dtype=torch.bool) | ~shown  # the direction of a hidden signature is rounding
    nearest = torch.where(itself_or_hidden, 1.0, apart).amin(dim=1)
    return Diagnosability(
        faults=tuple(faults),
        units=tuple(p.unit for p in fitting.space)[:count],
        sensors=tuple(sensor.name for sensor in plant.sensors),
        shows=_rows(torch.linalg.vector_norm(scaled[..., :count], dim=0).mT),
        apart=_rows(apart),
        structurally_apart=tuple(tuple(structural[f].get(g, False) for g in prefixes) for f in prefixes),
        rank=int((torch.linalg.svdvals((signatures / length)[:, shown]) > SAME).sum()) if bool(shown.any()) else 0,
        std=tuple(torch.where(shown, joint.std[:count], torch.inf).tolist()),
        std_by_correlation=tuple(torch.where(shown, correlation_certainty.std[:count], torch.inf).tolist()),
        smallest_detectable=tuple(detectable.tolist()),
        smallest_isolable=tuple(_limits(length * nearest, length, largest).tolist()),
        groups=tuple(_groups(plant, faults, apart)),
        remarks=tuple(g.sentence for g in undetermined_groups(fitting.space, theta, joint))
        + _remarks(readings, shown, faults),
    )


def without_gain_and_offset(slopes: Tensor, readings: Tensor) -> Tensor:
    """Sensitivities (S, C, P) projected onto the complement of each channel's gain and offset.

    A correlation objective is sensitive to this part only (erratum 6).
    """
    projected = []
    for c in range(readings.shape[1]):
        basis = torch.stack([torch.ones_like(readings[:, c]), readings[:, c] - readings[:, c].mean()], dim=1)
        basis = basis / torch.linalg.vector_norm(basis, dim=0).clamp(min=1e-12)
        q = torch.linalg.qr(basis).Q
        part = slopes[:, c] - q @ (q.mT @ slopes[:, c])
        zero = torch.linalg.vector_norm(part, dim=0) <= ROUNDING * torch.linalg.vector_norm(slopes[:, c], dim=0)
        projected.append(torch.where(zero, 0.0, part))
    return torch.stack(projected, dim=1)


def without_constants(scaled: Tensor, faults: int, std: Tensor) -> Tensor:
    """Signatures (K, F) of faults, in noise standard deviations, less the part that uncertain constants explain."""
    flat = scaled.flatten(0, 1)
    signatures, constants = flat[:, :faults], flat[:, faults:]
    if not constants.shape[1]:
        return signatures
    # A prior acts as one more reading of the constant: rows of 1/std that no fault affects.
    prior = torch.diag(1.0 / std[faults:])
    constants = torch.cat([constants, prior])
    signatures = torch.cat([signatures, signatures.new_zeros(len(prior), faults)])
    q = torch.linalg.qr(constants).Q
    return signatures - q @ (q.mT @ signatures)


def sines(signatures: Tensor) -> Tensor:
    """Sine (F, F) of the angle between columns of (K, F), accurate for small angles too."""
    length = torch.linalg.vector_norm(signatures, dim=0)
    unit = signatures / torch.where(length > 0, length, 1.0)
    rows = []
    for i in range(unit.shape[1]):
        along = (unit[:, i : i + 1] * unit).sum(dim=0)
        rows.append(torch.linalg.vector_norm(unit - unit[:, i : i + 1] * along, dim=0))
    table = torch.stack(rows)
    return torch.where(torch.eye(len(table), dtype=torch.bool), torch.zeros_like(table), table)


def _groups(plant: PlantDescription, faults: Sequence[str], apart: Tensor) -> list[str]:
    """Texts about faults with identical signatures, one for each group."""
    remaining, texts = list(range(len(faults))), []
    while remaining:
        first, *others = remaining
        identical = [j for j in others if float(apart[first, j]) < SAME]
        remaining = [j for j in others if j not in identical]
        if identical:
            members = [faults[first], *(faults[j] for j in identical)]
            words = listed([parameter_words(member) for member in members])
            texts.append(f"{words} are indistinguishable: {_reason(plant, members)}")
    return texts


def _reason(plant: PlantDescription, members: Sequence[str]) -> str:
    places = dict.fromkeys(ParameterName.parse(name).place for name in members)
    if len(places) == 1:
        return f"each is the same change of {next(iter(places))}"
    components = [plant.component(place) for place in places]
    sources = {c.source for c in components if isinstance(c, Pipe) and c.is_outlet}
    tanks = {c.name for c in components if isinstance(c, Tank)}
    holes = [c for c in components if isinstance(c, Tank) or (isinstance(c, Pipe) and c.is_outlet)]
    if sources and len(holes) == len(components) and len(sources | tanks) == 1:
        tank = next(iter(sources))
        return f"both are flows in proportion to sqrt(2 g h) of {tank}, so that the data determine only their sum"
    return "their signatures are the same under these inputs; other inputs or sensors may distinguish them"


def _remarks(readings: Tensor, shown: Tensor, faults: Sequence[str]) -> tuple[str, ...]:
    invisible = [name for name, shows in zip(faults, shown.tolist(), strict=True) if not shows]
    constant = (readings.amax(0) - readings.amin(0) <= CONSTANT * readings.abs().amax(0)).nonzero().flatten().tolist()
    remarks = [f"{name} does not show in any reading at any size of its range" for name in invisible]
    if constant:
        numbers = ", ".join(str(c + 1) for c in constant)
        remarks.append(f"without a fault reading {numbers} is constant: its correlation is undefined")
    return tuple(remarks)


def _limits(length: Tensor, whole: Tensor, largest: Tensor) -> Tensor:
    """Sizes (F,) whose signature has the length REACH; infinite beyond the largest size of a fault."""
    sizes = torch.where(length > SAME * whole, REACH / length, torch.inf)
    return torch.where(sizes <= largest, sizes, torch.inf)


def _rows(table: Tensor) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in table.tolist())
