"""Plan of a study: settings with their trials, divided into blocks.

The random draws of a trial depend on (seed, setting, trial) only, so that it is the same in any block, order or
process.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, groupby
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fdi_torch.estimate.draws import stream, uniform
from fdi_torch.estimate.evolution_settings import EvolutionSettings
from fdi_torch.estimate.fitting import Fitting
from fdi_torch.estimate.levenberg_marquardt import RefineSettings
from fdi_torch.estimate.objectives import Objective
from fdi_torch.parameters import ParameterSpace
from fdi_torch.study.estimators import Estimator

SnrDefinition = Literal["variance", "power"]

# Independent random streams of a study.
_FAULTS, _NOISE, _SEARCH = range(3)


@dataclass(frozen=True)
class Setting:
    """One condition with many trials.

    faults (trials, P), SI: true values of each trial. snr_db: of each output; None for readings without noise.
    """

    name: str
    faults: Tensor
    snr_db: float | None

    @property
    def trials(self) -> int:
        return len(self.faults)


@dataclass(frozen=True)
class Block:
    """Trials first..last-1 of one setting; `offset`: how many trials of the study precede the setting's first."""

    setting: int
    first: int
    last: int
    offset: int

    @property
    def numbers(self) -> range:
        """The trials' numbers in the whole study."""
        return range(self.offset + self.first, self.offset + self.last)


@dataclass(frozen=True)
class Method:
    """How every trial is estimated.

    estimators: those that are reported. search, search_step (s), search_every: differential evolution on every n-th
    reading; starts: number of its best distant members to refine. searches: largest number of searches for a trial
    whose residuals exceed its noise. steps (s): integration steps of the refinement, coarse to fine. data_step (s): of
    the noise-free readings.
    """

    estimators: tuple[Estimator, ...]
    objective: Objective
    search: EvolutionSettings
    search_step: float
    search_every: int
    starts: int
    searches: int
    steps: tuple[float, ...]
    refine: RefineSettings
    data_step: float


@dataclass(frozen=True)
class Plan:
    """The complete study. fitting: plant, clock, inputs and parameters; its readings are not used."""

    fitting: Fitting
    settings: tuple[Setting, ...]
    method: Method
    seed: int
    snr_definition: SnrDefinition
    block: int

    @property
    def device(self) -> torch.device:
        return self.fitting.device

    @property
    def trials(self) -> int:
        return sum(setting.trials for setting in self.settings)

    def blocks(self) -> Iterator[Block]:
        offset = 0
        for k, setting in enumerate(self.settings):
            for first in range(0, setting.trials, self.block):
                yield Block(k, first, min(first + self.block, setting.trials), offset)
            offset += setting.trials

    def blocks_of(self, numbers: Iterable[int]) -> Iterator[Block]:
        """The trials with these numbers, grouped into blocks. Raises ValueError for a number that no trial has."""
        chosen_numbers = set(numbers)
        for number in sorted(chosen_numbers):
            if not 0 <= number < self.trials:
                raise ValueError(f"expected trials from 0 to {self.trials - 1}, got {number}")
        for block in self.blocks():
            for left_out, run in groupby(block.numbers, lambda number: number not in chosen_numbers):
                chosen = [] if left_out else list(run)
                if chosen:
                    yield replace(block, first=chosen[0] - block.offset, last=chosen[-1] + 1 - block.offset)

    def noise(self, block: Block, shape: tuple[int, ...]) -> Float[Tensor, "trials ..."]:
        """Standard normal draws, with one generator per trial; the same on every device."""
        base = _key(self.seed, _NOISE, block.setting)
        # The generator uses 32 bits of its seed; consecutive seeds give each trial of a setting its own.
        seeds = [(base + trial) % 2**32 for trial in range(block.first, block.last)]
        made = [torch.Generator().manual_seed(seed) for seed in seeds]
        draws = [torch.randn(shape, generator=g, dtype=torch.float64, device="cpu") for g in made]
        return torch.stack(draws).to(self.device)

    def search_seeds(self, block: Block, again: int = 0) -> Int[Tensor, " trials"]:
        """Seeds of a search; each repetition has other ones."""
        base = _key(self.seed, _SEARCH, block.setting, again)
        return stream(torch.arange(block.first, block.last) + base)


def fixed_faults(theta: Float[Tensor, " P"], trials: int) -> Float[Tensor, "trials P"]:
    """The same fault in every trial."""
    return theta.expand(trials, -1).clone()


def uniform_faults(space: ParameterSpace, trials: int, seed: int, setting: int = 0) -> Float[Tensor, "trials P"]:
    """Faults drawn evenly from the box."""
    unit = _unit_draws(seed, setting, trials, len(space))
    return space.low() + (space.high() - space.low()) * unit


def fault_modes(space: ParameterSpace) -> list[tuple[int, ...]]:
    """Every set of at least one faulty parameter, small sets first: 31 of five."""
    places = range(len(space))
    return [mode for size in range(1, len(space) + 1) for mode in combinations(places, size)]


def mode_faults(
    space: ParameterSpace, mode: Iterable[int], smallest: float, trials: int, seed: int, setting: int
) -> Float[Tensor, "trials P"]:
    """Faults of the parameters of `mode` only, the others nominal.

    Each is uniform over the part of its box that is at least `smallest` of the box's width away from nominal.
    """
    unit = _unit_draws(seed, setting, trials, len(space))
    theta = space.nominal().expand(trials, -1).clone()
    for i in mode:
        p = space.parameters[i]
        gap = smallest * (p.high - p.low)
        below, above = max(p.nominal - gap - p.low, 0.0), max(p.high - p.nominal - gap, 0.0)
        if below + above <= 0:
            raise ValueError(f"{p.name}: expected room for a fault of {smallest:g} of its range, got none; lower it")
        along = unit[:, i] * (below + above)
        theta[:, i] = torch.where(along < below, p.low + along, p.nominal + gap + along - below)
    return theta


def _unit_draws(seed: int, setting: int, trials: int, width: int) -> Tensor:
    key = stream(torch.arange(trials) + _key(seed, _FAULTS, setting))
    return uniform(key, width)


def _key(seed: int, *counters: int) -> int:
    """A 48-bit key, so that trial numbers can be added."""
    return int(stream(torch.tensor(seed), *counters)) & (2**48 - 1)
