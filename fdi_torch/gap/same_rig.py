"""Is the hold-out of the same rig? Asked where what explains the recording leaves much of the hold-out open.

The same causes and constants are fitted to the hold-out anew. Where that explains it, what had to change says what is
different there; where it does not, something acts there that the recording does not show.
"""

from __future__ import annotations

import math

from fdi_torch.gap.closure import HeldOut
from fdi_torch.gap.finding import Finding, left_open
from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.gap.floor import slow_excess
from fdi_torch.gap.standard_errors import standard_errors
from fdi_torch.parameters import display_unit

OPEN_SHARE, OPEN_LEAST = 0.2, 200.0  # of the hold-out's own gap, and chi-square units
EXPLAINS = 0.3  # of what was open, left by the new fit
APART = 5.0  # standard errors


def other_rig(found: Finding, held: HeldOut) -> str | None:
    """One sentence where the hold-out does not fit to what was found in the recording, else None."""
    if found.unnamed or not found.explained:
        return None
    mask, noise = held.subject.mask, held.noise
    white = noise.whiten(held.subject.readings - held.runs["augmented"], mask)
    still = slow_excess(white)
    gap = slow_excess(noise.whiten(held.subject.readings - held.runs["recalibrated"], mask))
    if still < max(OPEN_SHARE * gap, OPEN_LEAST):
        return None
    fitter = Fitter(held.subject, noise)
    again = fitter.fit(Candidate(found.best.candidate.placements, (found.best.effect_values,)))
    source = held.subject.recording.source or "the hold-out"
    changed = _changed(found, fitter, again) if left_open(fitter, again) < EXPLAINS * still else []
    if changed:
        needed = ", ".join(changed[:3])
        return (
            f"{source} needs other constants than the recording ({needed}): it is of another rig, or the rig was "
            "changed in between; how far the gap closes there says little"
        )
    return (
        f"what explains the recording does not explain {source}, whatever the constants: something acts there that the "
        "recording does not show, or it is of another rig"
    )


def _changed(found: Finding, fitter: Fitter, again: Fit) -> list[str]:
    """What differs by many standard errors, farthest first, as in 'P13.discharge_coefficient 0.66, not 0.6'."""
    before, after = found.best.values, again.values
    errors = standard_errors(found.fitter, found.best), standard_errors(fitter, again)
    apart = {
        n: abs(after[n] - before[n]) / max(math.hypot(errors[0][n], errors[1][n]), 1e-300)
        for n in after
        if not n.endswith(".start_level")
    }
    names = sorted((n for n in apart if apart[n] > APART), key=lambda n: -apart[n])
    return [f"{n} {_shown(after[n], again, n)}, not {_shown(before[n], again, n)}" for n in names]


def _shown(value: float, fit: Fit, name: str) -> str:
    unit, scale = display_unit(fit.space[name].unit)
    return f"{scale * value:.4g} {unit}".rstrip()
