"""Rival faults: suspected faults of which at least one is present although the readings do not tell which.

`joint_fault_test.py` finds them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from fdi_torch.amounts import estimate_words, parameter_words, probability_words, sized_words
from fdi_torch.names import listed


@dataclass(frozen=True)
class Explanation:
    """Faults that together explain the readings, the other rivals being nominal, with sizes and standard errors (SI).

    probability: among all explanations with at least one of the rivals.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    value: tuple[float, ...]
    std: tuple[float, ...]
    probability: float

    @property
    def sentence(self) -> str:
        """'leak at A (size 0.197 ± 0.015) alone explains the readings: probability 97.0 %'."""
        each = zip(self.names, self.units, self.value, self.std, strict=True)
        faults = [sized_words(n, [estimate_words(n, unit, value, std)]) for n, unit, value, std in each]
        verb = "alone explains" if len(faults) == 1 else "together explain"
        return f"{listed(faults)} {verb} the readings: probability {probability_words(self.probability)}"

    @property
    def words(self) -> str:
        """'leak at A: 97.0 %'."""
        return f"{listed([parameter_words(name) for name in self.names])}: {probability_words(self.probability)}"


@dataclass(frozen=True)
class RivalFaults:
    """Faults of which at least one is present. chi_square: Lambda of `names`. probability: confidence level at which
    they differ from nominal together. explanations: the likeliest first.
    """

    names: tuple[str, ...]
    chi_square: float
    probability: float
    explanations: tuple[Explanation, ...]

    @property
    def rivals(self) -> str:
        """'leak at A, leak at B or plugging at link'."""
        return listed([parameter_words(name) for name in self.names], "or")

    @property
    def sized_rivals(self) -> str:
        """The rivals with the probabilities of the explanations."""
        return f"{self.rivals} ({'; '.join(e.words for e in self.explanations)})"

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is known of them, one sentence each."""
        first = f"at least one of them is present, with a confidence of {probability_words(self.probability)}"
        why = "none differs significantly from nominal alone, because the readings hardly distinguish them"
        return first, why, *(explanation.sentence for explanation in self.explanations)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> RivalFaults:
        """The rivals of `to_dict`. Raises KeyError, TypeError or ValueError for anything else."""
        explanations = []
        for each in plain["explanations"]:
            names, units = (tuple(map(str, each[key])) for key in ("names", "units"))
            value, std = (tuple(map(float, each[key])) for key in ("value", "std"))
            if not len(names) == len(units) == len(value) == len(std):
                raise ValueError(f"expected a unit, a value and an error for each of {len(names)} faults")
            explanations.append(Explanation(names, units, value, std, float(each["probability"])))
        chi_square, probability = (float(plain[key]) for key in ("chi_square", "probability"))
        return cls(tuple(map(str, plain["names"])), chi_square, probability, tuple(explanations))
