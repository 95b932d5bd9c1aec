"""Whether the model explains the recording: said first, and the exit code of train, refit and predict."""

from __future__ import annotations

from collections.abc import Sequence

from fdi_torch.cli import DONE, NOT_EXPLAINED
from fdi_torch.cli.screen import Screen
from fdi_torch.estimate.misfit import Misfit


def say_first(misfit: Misfit, screen: Screen, *hints: str, about: Sequence[str] = ()) -> None:
    """Print the warning, what it is about and what to do next if the model does not explain the recording."""
    if misfit.warning:
        screen.say(f"{misfit.warning}.")
        screen.points(about)
        gap = (
            "next: fdi gap distinguishes random disturbances of the flows from an error of the plant file, and names "
            "its place and cause"
        )
        screen.points((gap, *hints))
        screen.say()


def say_doubts(doubts: Sequence[str], screen: Screen) -> None:
    """Print what limits the trust in the recordings, if anything does."""
    if doubts:
        screen.say("Doubts about the recording:")
        screen.points(doubts)
        screen.say()


def exit_code(misfit: Misfit) -> int:
    return DONE if misfit.explained else NOT_EXPLAINED
