"""What may have changed, what a fit made of it, and the posterior over all that was fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from fdi_torch.estimate.evidence import posterior


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

    evidence: log of its evidence and prior odds over those of "no change", nats. mass: its share of the posterior over
    everything fitted beside it. misfit: half the sum of squares of the white innovations; readings: what noise leaves
    of twice that on average; expected: at most, to four standard deviations. at_end: columns whose value ended at an
    end of their range.
    """

    hypothesis: Hypothesis
    value: Tensor
    std: Tensor
    onset: float
    onset_std: float
    evidence: float
    misfit: float
    readings: float
    expected: float
    at_end: tuple[int, ...] = ()
    mass: float = 1.0

    @property
    def fits(self) -> bool:
        """Whether the white innovations are no larger than noise, and no value has run into the end of its range."""
        return 2.0 * self.misfit <= self.expected and not self.at_end

    @property
    def rest(self) -> float:
        """What it leaves, as a multiple of noise; 1 where that is noise."""
        return max(2.0 * self.misfit / self.readings, 1.0) if 2.0 * self.misfit > self.expected else 1.0


NOTHING = Hypothesis(())


def ranked(found: Sequence[Finding]) -> list[Finding]:
    """With their masses, likeliest first.

    Where even the closest explanation leaves more than noise, the laws themselves are off, and what one says for or
    against another counts for less by the share of that rest: a quasi-likelihood (McCullagh and Nelder, 1989,
    "Generalized linear models", chapter 9).
    """
    closest = min(found, key=lambda finding: finding.misfit)
    excess, widened = closest.rest, closest.rest**0.5
    if excess > 1.0:
        found = [
            replace(
                f,
                std=f.std * widened,
                onset_std=f.onset_std * widened,
                evidence=f.evidence + (f.misfit - closest.misfit) * (1.0 - 1.0 / excess),
            )
            for f in found
        ]
    masses = posterior([f.evidence for f in found])
    weighed = [replace(f, mass=mass) for f, mass in zip(found, masses, strict=True)]
    return sorted(weighed, key=lambda finding: -finding.mass)


def distinct(found: Sequence[Finding]) -> list[Finding]:
    """One finding for each set of parameters that change, with the mass of all of them: whether a fault came at once or
    little by little is no other explanation. Likeliest first.
    """
    groups: dict[tuple[tuple[int, ...], tuple[int, ...]], Finding] = {}
    for f in sorted(found, key=lambda finding: -finding.mass):
        key = f.hypothesis.columns, f.hypothesis.gone
        groups[key] = replace(groups[key], mass=groups[key].mass + f.mass) if key in groups else f
    return sorted(groups.values(), key=lambda finding: -finding.mass)


def content(found: Sequence[Finding], level: float = 0.95) -> list[Finding]:
    """The fewest of distinct findings that hold so much of the posterior, and every exact twin of one of them: a set
    of as many faults that leaves the same misfit.
    """
    held = 0.0
    kept: list[Finding] = []
    for f in found:
        if held >= level and not any(_twins(f, k) for k in kept):
            continue
        kept.append(f)
        held += f.mass
    return kept


def _twins(a: Finding, b: Finding) -> bool:
    """Whether no reading can tell the two apart; differences of a hundredth of a nat are those of unfinished fits."""
    return len(a.hypothesis.sizes) == len(b.hypothesis.sizes) > 0 and abs(a.misfit - b.misfit) < 0.01
