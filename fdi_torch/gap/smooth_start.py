"""A first course of the levels where a sharp bend keeps it from being found: by way of plants drawn smooth.

Newton's steps follow a rim that runs over from the wrong side of it, and miss. With rims and roots drawn as smooth as
for steps WIDENINGS times as long a course is found, and from there the next (continuation: Allgower and Georg, 1990).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from fdi_torch.gap.fitting import Candidate, Fit, Fitter
from fdi_torch.gap.subject import Part, Subject
from fdi_torch.simulate.experiment import Experiment

WIDENINGS = (64.0, 16.0, 4.0, 2.0)


def first_fit(fitter: Fitter, candidate: Candidate, base: Fit | None = None) -> Fit:
    """The fit, as it is where its course of the levels is found at once."""
    found = fitter.fit(candidate, base)
    if followed(found):
        return found
    for widening in WIDENINGS:
        wide = Fitter(_drawn_smooth(fitter.subject, widening), fitter.noise).fit(candidate, base)
        if followed(wide):
            base = wide
    again = fitter.fit(candidate, base) if base is not None else found
    return again if followed(again) else found


def followed(fit: Fit) -> bool:
    """Whether the course of its levels was found."""
    return math.isfinite(fit.cost) and bool(torch.isfinite(fit.near.jacobian).all())


def _drawn_smooth(subject: Subject, widening: float) -> Subject:
    def wider(experiment: Experiment) -> Experiment:
        return replace(experiment, resolution=widening * experiment.resolution)

    further: list[Part] = [replace(part, experiment=wider(part.experiment)) for part in subject.further]
    return replace(subject, experiment=wider(subject.experiment), further=tuple(further))
