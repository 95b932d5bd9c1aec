"""What may have changed, and what a fit made of it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Hypothesis:
    """Which columns of the space change together, and whether at once or little by little.

    shape: those of them that say how (period and phase of an oscillation), not how much. gone: those that only go back
    to nominal, which leaves nothing of them to be found but when.
    """

    columns: tuple[int, ...]
    incipient: bool = False
    shape: tuple[int, ...] = ()
    gone: tuple[int, ...] = ()

    @property
    def free(self) -> list[int]:
        """The columns whose values are to be found."""
        return [c for c in self.columns if c not in self.gone]

    @property
    def sizes(self) -> tuple[int, ...]:
        """The columns that say how much."""
        return tuple(c for c in self.columns if c not in self.shape)

    def beside(self, fault: Fault) -> Hypothesis:
        """With another fault that comes at the same time."""
        columns, shape = {*self.columns, *fault.columns}, {*self.shape, *fault.shape}
        return Hypothesis(tuple(sorted(columns)), self.incipient, tuple(sorted(shape)), self.gone)


@dataclass(frozen=True)
class Fault:
    """One fault of the list: the column of its size, and of its period and phase where it swings."""

    size: int
    shape: tuple[int, ...] = ()

    @property
    def columns(self) -> tuple[int, ...]:
        return (self.size, *self.shape)


@dataclass(frozen=True)
class Finding:
    """A hypothesis fitted: value and std (P,) of its columns (others as believed, 0), onset and its std in s.

    score: Bayesian information criterion against "no change"; the most negative is the best.
    misfit: half the sum of squares of the white innovations. readings: how many there were.
    """

    hypothesis: Hypothesis
    value: Tensor
    std: Tensor
    onset: float
    onset_std: float
    score: float
    misfit: float
    readings: int

    @property
    def fits(self) -> bool:
        """Whether the white innovations are no larger than noise, to four standard deviations of their squares' sum."""
        return 2.0 * self.misfit <= self.readings + 4.0 * (2.0 * self.readings) ** 0.5
