"""What the observer would have seen had some parameters changed at some moment: innovations of hypothetical changes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.monitor.changing import ONSET, RAMP, ChangingNetwork
from fdi_torch.monitor.gain import Gain
from fdi_torch.monitor.observer import first_levels
from fdi_torch.monitor.running import run_lanes
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import Stepper
from fdi_torch.monitor.whitening import Whitening
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork

NEVER, LONG_AGO = 1e30, -1e30  # s
# Readings of all lanes that are worked on at once: what a processor's cache and a small machine's memory like.
MOST_READINGS = 2_000_000


@dataclass(frozen=True)
class Changes:
    """Hypotheses, one lane each: the parameters go from what is believed to `theta` (L, P) at `onset` (L,) s.

    incipient (L,) bool: not at once but in a straight line, from the onset to the last sample of the window.
    """

    theta: Tensor
    onset: Tensor
    incipient: Tensor

    def __len__(self) -> int:
        return len(self.theta)

    def part(self, first: int, last: int) -> Changes:
        return Changes(self.theta[first:last], self.onset[first:last], self.incipient[first:last])

    def ramp(self, end: float) -> Tensor:
        """How long the change takes, (L,) s."""
        return torch.where(self.incipient, (end - self.onset).clamp(min=0.0), 0.0)


def unchanged(believed: Tensor) -> Changes:
    """The hypothesis that nothing of what is believed (P,) changes, as one lane."""
    return Changes(believed[None], believed.new_tensor([NEVER]), torch.tensor([False]))


@dataclass(frozen=True)
class Window:
    """A stretch in which a change is sought. samples: from the one after whose correction the observer's state was
    `state` (tanks + M,); number: how many the observer had then seen. What the others show is compared.
    """

    samples: Samples
    state: Tensor
    number: int

    def __len__(self) -> int:
        return len(self.samples) - 1

    @property
    def times(self) -> Tensor:
        """Of the samples that are compared, (S,) s."""
        return self.samples.time[1:]

    @property
    def readings(self) -> int:
        """How many there are."""
        return int(torch.isfinite(self.samples.readings[1:]).sum())


class ChangedObserver:
    """An observer run along a window under many hypotheses at once.

    Where a hypothesis is right its innovations are white: half their sum of squares is its negative log-likelihood
    (prediction-error method; Ljung 1999, ch. 7). believed (P,): values of `space` before the change.

    effects: the columns of `space` that belong together, such as an oscillation's amplitude, period and phase. One
    that remembers and has an onset of its own (a stuck sensor keeps what it read then) is given the change's.
    """

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        gain: Gain,
        whitening: Whitening,
        longest_step: float | None = None,
    ) -> None:
        self.stepper = Stepper(network, longest_step)
        self.network, self.space, self.gain, self.whitening = network, space, gain, whitening
        self.changing = ChangingNetwork(network, space.names)
        self._held = _with_own_onset(network, space)
        onsets = [f"{name.rpartition('.')[0]}.onset" for name in self._held]
        names = [*space.names, *(f"after {name}" for name in space.names), ONSET, RAMP, *onsets]
        groups: dict[str, list[int]] = {}
        for column, name in enumerate(space.names):
            groups.setdefault(name.rpartition(".")[0], []).append(column)
        self.effects = tuple(tuple(columns) for columns in groups.values())
        self._columns = ParameterSpace(self.changing.constants[name] for name in names)

    def white(self, window: Window, believed: Tensor, changes: Changes) -> Tensor:
        """White innovations (L, S, sensors); zero where a reading or one that it is compared with is missing."""
        white = self.whitening(self.follow(window, believed, changes)[1])
        white[:, : self.whitening.order] = 0.0
        return torch.nan_to_num(white, nan=0.0)

    def blocks(self, window: Window, changes: Changes, even: int = 1) -> list[Changes]:
        """The hypotheses in parts that fit into memory side by side, each of a multiple of `even`."""
        size = even * max(MOST_READINGS // (even * len(window) * len(self.network.description.sensors)), 1)
        return [changes.part(first, first + size) for first in range(0, len(changes), size)]

    def follow(self, window: Window, believed: Tensor, changes: Changes) -> tuple[Tensor, Tensor]:
        """States (L, S, tanks + M) after each sample, and residuals (L, S, sensors) at the steady ones' spread."""
        samples, count = window.samples, len(window)
        ran = run_lanes(
            self.changing,
            self._columns,
            self._lanes(believed, changes, float(samples.time[-1])),
            samples,
            window.state.expand(len(changes), -1),
            self.gain.table(window.number, count),
            self.stepper.longest,
            from_first=False,
        )
        return ran.state, (samples.readings[1:] - ran.expected) / self.gain.spread(window.number, count)

    def first_state(self, samples: Samples, believed: Tensor, levels: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """State (tanks + M,) after the first sample of a run, its levels from the readings, and the residual there."""
        first = samples.stretch(0, 1)
        if levels is None:
            levels = first_levels(self.network, samples, self.network.bind(self.space, believed))
        ran = run_lanes(
            self.changing,
            self._columns,
            self._lanes(believed, unchanged(believed), float(first.time[0])),
            first,
            levels[None],
            self.gain.table(0, 1),
            self.stepper.longest,
            from_first=True,
        )
        return ran.state[0, 0], (first.readings[0] - ran.expected[0, 0]) / self.gain.spread(0, 1)[0]

    def space_width(self) -> Tensor:
        """The length of each parameter's range, (P,); its size or 1 where it has none."""
        low, high = self.space.low(), self.space.high()
        typical = self.space.nominal().abs()
        width = torch.where(torch.isfinite(high - low), high - low, torch.where(typical > 0, typical, 1.0))
        return width

    def _lanes(self, believed: Tensor, changes: Changes, end: float) -> Tensor:
        """What the changing plant wants to know of each hypothesis, (L, columns)."""
        before = believed.expand(len(changes), -1)
        moment = torch.stack([changes.onset, changes.ramp(end)], dim=1)
        own = []
        for name in self._held:
            p = self.space.parameters[self.space.index(name)]
            already = before[:, self.space.index(name)] != p.nominal
            own.append(torch.where(already, LONG_AGO, changes.onset))
        return torch.cat([before, changes.theta, moment, *(column.unsqueeze(1) for column in own)], dim=1)


def _with_own_onset(network: TankNetwork, space: ParameterSpace) -> list[str]:
    """The parameters of `space` that are sizes of effects with a memory and an onset."""
    named = []
    for placement in network.placements:
        size, *shape = placement.effect.parameters(placement.location, network.description)
        name = f"{placement.prefix}.{size.name}"
        if placement.effect.memory and any(p.name == "onset" for p in shape) and name in space:
            named.append(name)
    return named
