"""The diagnosis on the drawing of a rig: levels, texts at components, strength of colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import wrap

import numpy as np

from fdi_torch.report.html import short
from fdi_torch.report.numbers import percent, shown_unit
from fdi_torch.report.style import INK
from fdi_torch.report.text_blocks import LetterStyle

LETTERS, LONGEST = 9, 40  # letters per line, and per effect
LEAST_SHARE = 0.005  # of a probability that is written


@dataclass(frozen=True)
class Overlay:
    """The diagnosis to draw. levels: tank -> m. marks: location -> texts of diagnosed effects. probabilities: location
    -> probability of a discrepancy there (0 to 1), drawn as strength of colour.
    """

    levels: Mapping[str, float] = field(default_factory=dict)
    marks: Mapping[str, Sequence[str]] = field(default_factory=dict)
    probabilities: Mapping[str, float] = field(default_factory=dict)

    def lines(self, name: str, colour: str) -> list[LetterStyle]:
        """The lines at a component: its effects, one below the other, in this colour, and the probability."""
        marks = self.marks.get(name, ())
        lines: list[LetterStyle] = []
        for text in marks:
            first, *others = wrap(short(text, LONGEST), LETTERS, break_long_words=False) or [""]
            bullet = "• " if len(marks) > 1 else ""
            lines += [(line, colour, "bold") for line in (bullet + first, *others)]
        share = self.probabilities.get(name, 0.0)
        return [*lines, (percent(share), INK, "bold")] if share >= LEAST_SHARE else lines


def strength(share: float) -> float:
    """Opacity of a location by its probability (0 to 1); cubic, so that certain locations stand out."""
    return 0.3 * share**3


def level_text(level: float) -> str:
    """A level to about one millimetre."""
    unit, scale = shown_unit("m")
    return f"{scale * level:.{max(0, 3 - int(np.log10(scale)))}f} {unit}"
