"""Progress of a stage of the diagnosis whose extent shows only while it is carried out."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from fdi_torch.gap.answer import CauseName
from fdi_torch.gap.verdict_words import explanation_words
from fdi_torch.progress import Tell, silent

SO_FAR = ", so far "
"""What separates a stage from the likeliest causes so far in a progress message."""


@dataclass
class StageProgress:
    """Counts the steps of a stage: fits, evaluations of explanations, places examined.

    The share is that of the steps done among those known so far, between begin and end, and never falls.
    """

    progress: Tell = silent
    stage: str = ""
    begin: float = 0.0
    end: float = 1.0
    _words: str = ""
    _done: int = 0
    _known: int = 0
    _share: float = 0.0

    def remaining(self, steps: int) -> None:
        """State how many steps are still known to follow."""
        self._known = self._done + steps

    def step(self) -> None:
        """Count a step."""
        self._done += 1
        share = min(self._done / max(self._known, 1), 1.0)
        self._share = max(self._share, self.begin + (self.end - self.begin) * share)
        self._tell()

    def so_far(self, causes: Collection[CauseName]) -> None:
        """Tell the likeliest causes so far."""
        named = [{"effect": effect, "location": place} for effect, place in sorted(causes)]
        self._words = f"{SO_FAR}{explanation_words(named)}"
        self._tell()

    def _tell(self) -> None:
        self.progress(max(self._share, self.begin), f"{self.stage}{self._words}")
