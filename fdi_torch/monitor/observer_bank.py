"""Bank of observers, one for each hypothesis that some parameters changed at some time, and their innovations."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.estimate.uncertainty import end_reached
from fdi_torch.monitor.law_errors import STEP, ConstantErrors, raised
from fdi_torch.monitor.observer import ObserverRun, initial_levels, run_observers
from fdi_torch.monitor.observer_gain import Gain
from fdi_torch.monitor.samples import Samples
from fdi_torch.monitor.stepper import Stepper
from fdi_torch.monitor.switched_plant import ONSET, RAMP, SwitchedNetwork, own_onsets
from fdi_torch.monitor.whitening import Whitening
from fdi_torch.parameters import ParameterName, ParameterSpace
from fdi_torch.plant.network import TankNetwork

NEVER, LONG_AGO = 1e30, -1e30  # s
# Readings of all hypotheses processed at once; limits the memory, and fits a processor's cache.
LARGEST_BATCH = 2_000_000
SHOCK_READING = 1e15  # far above any reading, in any unit


@dataclass(frozen=True)
class ChangeHypotheses:
    """L hypotheses, one lane each: the parameters change from their present values to `theta` (L, P) at `onset` (L,) s.

    incipient (L,) bool: the change is linear from the onset to the last sample of the window instead of sudden.
    """

    theta: Tensor
    onset: Tensor
    incipient: Tensor

    def __len__(self) -> int:
        return len(self.theta)

    def subset(self, first: int, last: int) -> ChangeHypotheses:
        return ChangeHypotheses(self.theta[first:last], self.onset[first:last], self.incipient[first:last])

    def ramp(self, end: float) -> Tensor:
        """Duration of the change, (L,) s."""
        return torch.where(self.incipient, (end - self.onset).clamp(min=0.0), 0.0)


def sudden_changes(theta: Tensor, onset: Tensor | float) -> ChangeHypotheses:
    """Sudden changes to theta (L, P) at an onset of each (L,), or of all, s."""
    return ChangeHypotheses(theta, theta.new_zeros(len(theta)) + onset, torch.zeros(len(theta), dtype=torch.bool))


def no_change(believed: Tensor) -> ChangeHypotheses:
    """The hypothesis that the parameters (P,) do not change, as one lane."""
    return sudden_changes(believed[None], NEVER)


@dataclass(frozen=True)
class ObserverWindow:
    """A time window in which a change is searched for.

    samples: the first one only sets the start; `state` (order + M,) is the observer's state after its correction,
    `number` the count of samples that the observer had processed by then, and `memory` that of the flow filter
    (None: zero). The later samples are compared.
    """

    samples: Samples
    state: Tensor
    number: int
    memory: Tensor | None = None

    def __len__(self) -> int:
        return len(self.samples) - 1

    @property
    def times(self) -> Tensor:
        """Times of the compared samples, (S,) s."""
        return self.samples.time[1:]

    @property
    def readings(self) -> int:
        """Number of readings in the compared samples."""
        return int(torch.isfinite(self.samples.readings[1:]).sum())


class ObserverBank:
    """Observers run along a window under many hypotheses in parallel.

    Under the true hypothesis the innovations are white, and half their sum of squares is the negative log-likelihood
    (prediction-error method; Ljung 1999, ch. 7). In all methods believed (P,) are the values of `space` before the
    change.

    constants: errors of constants with a tolerance. To first order, errors g ~ N(0, S) of these add A g to the
    innovations. With A S^(1/2) = U D V', innovations e are therefore white as e - U (1 - (1 + D^2)^(-1/2)) U'e, which
    is the marginal likelihood over the errors. effects: groups of columns of `space` that belong to one
    effect, such as amplitude, period and phase of an oscillation. An effect with a memory and an onset parameter (a
    stuck sensor keeps its reading at the onset) gets the onset of the change.
    """

    def __init__(
        self,
        network: TankNetwork,
        space: ParameterSpace,
        gain: Gain,
        whitening: Whitening,
        longest_step: float | None = None,
        constants: ConstantErrors | None = None,
    ) -> None:
        self.constants = constants or ConstantErrors()
        self.stepper = Stepper(network, longest_step)
        self.network, self.space, self.gain, self.whitening = network, space, gain, whitening
        self.changing = SwitchedNetwork(network, space.names)
        self._held = own_onsets(network, space)
        names = [*space.names, *(f"after {name}" for name in space.names), ONSET, RAMP, *self._held.values()]
        groups: dict[str, list[int]] = {}
        for column, name in enumerate(space.names):
            groups.setdefault(ParameterName.parse(name).prefix, []).append(column)
        self.effects = tuple(tuple(columns) for columns in groups.values())
        self._columns = ParameterSpace(self.changing.constants[name] for name in names)
        self._errors: tuple[ObserverWindow, Tensor, tuple[Tensor, Tensor, Tensor]] | None = None

    def white_innovations(self, window: ObserverWindow, believed: Tensor, changes: ChangeHypotheses) -> Tensor:
        """White innovations (L, S, sensors); zero where a reading, or one that the whitening needs, is missing."""
        blocks = self.in_blocks(window, changes)
        white = torch.cat([self._white(window, self.run(window, believed, block)[1]) for block in blocks])
        if not self.constants.columns:
            return white
        directions, shares, known = self._of_constants(window, believed)
        rest = white.flatten(1) - known
        return (rest - (rest @ directions * shares) @ directions.mT).reshape(white.shape)

    def knowing(self, constants: ConstantErrors) -> ObserverBank:
        """The same observers with other knowledge of the errors of constants."""
        bank = copy(self)
        bank.constants, bank._errors = constants, None
        return bank

    def _white(self, window: ObserverWindow, residual: Tensor) -> Tensor:
        """The white innovations of residuals if all constants are exact."""
        innovations, _ = self.whitening.innovations(residual, window.number, window.memory, states=False)
        white = self.whitening.of_innovations(innovations)
        white[:, : self.whitening.order] = 0.0
        return torch.nan_to_num(white, nan=0.0)

    def _beside_errors(self, window: ObserverWindow, believed: Tensor) -> Tensor:
        """Residuals (1 + P, S, sensors) without a change, and with each of P constants raised by STEP."""
        lanes = torch.cat([believed[None], raised(believed, self.space, self.constants.columns)])
        return self.run(window, lanes, sudden_changes(lanes, NEVER))[1]

    def _of_constants(self, window: ObserverWindow, believed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions U (S sensors, P) of the errors of P constants, the shares (P,) that they take, and what their mean
        adds to the innovations (S sensors,)."""
        if self._errors is None or self._errors[0] is not window or not torch.equal(self._errors[1], believed):
            white = self._white(window, self._beside_errors(window, believed)).flatten(1)
            effects = ((white[1:] - white[0]) / STEP).mT
            values, vectors = torch.linalg.eigh(self.constants.covariance)
            root = vectors * values.clamp(min=0.0).sqrt()
            directions, size, _ = torch.linalg.svd(effects @ root, full_matrices=False)
            mean = self.constants.mean
            known = effects.new_zeros(len(effects)) if mean is None else effects @ mean
            self._errors = window, believed, (directions, 1.0 - 1.0 / (1.0 + size.square()).sqrt(), known)
        return self._errors[2]

    def learning_from(
        self, window: ObserverWindow, believed: Tensor, change: ChangeHypotheses
    ) -> tuple[ObserverBank, float, float]:
        """The same observers, with random flows learnt from a window too, in which a change (one lane) took place, the
        log-likelihood of these flows, and what it gained over that of the present ones.
        """
        bank, residual = copy(self), self.run(window, believed, change)[1][0]
        beside = self._beside_errors(window, believed)
        bank._errors = None
        effects = (beside[1:] - beside[0]) / STEP
        bank.whitening, likelihood, gain = self.whitening.learning_from(residual, effects, window.number)
        return bank, likelihood, gain

    def in_blocks(self, window: ObserverWindow, changes: ChangeHypotheses, even: int = 1) -> list[ChangeHypotheses]:
        """The hypotheses in blocks that fit into memory; each block's size is a multiple of `even`."""
        size = even * max(LARGEST_BATCH // (even * len(window) * len(self.network.description.sensors)), 1)
        return [changes.subset(first, first + size) for first in range(0, len(changes), size)]

    def run(self, window: ObserverWindow, believed: Tensor, changes: ChangeHypotheses) -> tuple[Tensor, Tensor]:
        """States (L, S, order + M) after each sample, and residuals (L, S, sensors) scaled to the steady variance."""
        count, start = len(window), window.state.expand(len(changes), -1)
        ran = self._ran(window.samples, start, believed, changes, self.gain.table(window.number, count))
        return ran.state, (window.samples.readings[1:] - ran.expected) / self.gain.spread(window.number, count)

    def simulate(
        self, samples: Samples, start: Tensor, believed: Tensor, changes: ChangeHypotheses, shocks: Tensor
    ) -> Tensor:
        """States (L, S, order + M) of a free run from `start` (L, order + M): readings correct only the first sample.

        shocks (L, S, order) are added to the network's states, in m, at these samples. The engines inject them as the
        corrections of a reading so large that the prediction does not matter.
        """
        sensors = len(self.network.description.sensors)
        readings = start.new_full((len(samples), sensors), torch.nan)
        readings[:, 0] = SHOCK_READING
        gains = start.new_zeros(len(changes), len(samples) - 1, self.network.order, sensors)
        gains[..., 0] = shocks / SHOCK_READING
        return self._ran(replace(samples, readings=readings), start, believed, changes, gains).state

    def first_state(self, samples: Samples, believed: Tensor, levels: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """State (order + M,) after the first sample and the residual there. levels: from the readings if None."""
        first = samples.segment(0, 1)
        if levels is None:
            levels = initial_levels(self.network, samples, self.network.bind(self.space, believed))
        ran = self._ran(first, levels[None], believed, no_change(believed), self.gain.table(0, 1), from_first=True)
        return ran.state[0, 0], (first.readings[0] - ran.expected[0, 0]) / self.gain.spread(0, 1)[0]

    def space_width(self) -> Tensor:
        """Width of each parameter's range, (P,); its nominal magnitude, or 1, where the range is infinite."""
        low, high = self.space.low(), self.space.high()
        typical = self.space.nominal().abs()
        width = torch.where(torch.isfinite(high - low), high - low, torch.where(typical > 0, typical, 1.0))
        return width

    def search_space(self, believed: Tensor) -> ParameterSpace:
        """The space in which changes are searched for: it goes on beyond an end that a known fault has reached, because
        ranges are guesses, and a fault that is larger than its own would otherwise leave a residual for false ones.
        """
        space = self.space
        for p, value in zip(self.space, believed.tolist(), strict=True):
            end = end_reached(p, value)
            if end is not None:
                further = {"low": value - (p.high - p.low)} if end == p.low else {"high": value + (p.high - p.low)}
                space = space.with_changes(p.name, **further)
        return space

    def _ran(
        self,
        samples: Samples,
        start: Tensor,
        believed: Tensor,
        changes: ChangeHypotheses,
        gains: Tensor,
        from_first: bool = False,
    ) -> ObserverRun:
        lanes, longest = self._lanes(believed, changes, float(samples.time[-1])), self.stepper.longest
        return run_observers(self.changing, self._columns, lanes, samples, start, gains, longest, from_first)

    def _lanes(self, believed: Tensor, changes: ChangeHypotheses, end: float) -> Tensor:
        """Parameter values of the switched plant for each hypothesis, (L, columns)."""
        before = believed.expand(len(changes), -1)
        timing = torch.stack([changes.onset, changes.ramp(end)], dim=1)
        onsets = []
        for name in self._held:
            p = self.space.parameters[self.space.index(name)]
            already = before[:, self.space.index(name)] != p.nominal
            onsets.append(torch.where(already, LONG_AGO, changes.onset))
        return torch.cat([before, changes.theta, timing, *(column.unsqueeze(1) for column in onsets)], dim=1)
