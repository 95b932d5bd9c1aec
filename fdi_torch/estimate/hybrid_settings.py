"""Settings of the hybrid estimation: search, refinement and their integration steps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from fdi_torch.estimate.evolution import EvolutionSettings
from fdi_torch.estimate.levenberg_marquardt import RefineSettings
from fdi_torch.estimate.objectives import Objective

# Tolerances of the search with a slow engine: it only has to reach the basin of attraction of the refinement.
SLOW_PARAMETER_TOLERANCE, SLOW_COST_TOLERANCE, SLOW_SEARCH_TOLERANCE = 0.2, 1e-2, 0.1


@dataclass(frozen=True)
class HybridSettings:
    """Settings of search and refinement.

    objectives: objective of the search, objective of the refinement.
    method: 'lm' refines by Levenberg-Marquardt; 'none' takes the best member of the search as the estimate.
    search_step, refine_step: integration steps in s; None chooses them from the measured integration error.
    search_tolerance, refine_tolerance: admissible integration error, as a fraction of the standard deviation of each
    channel's readings over the search box.
    starts: number of good, mutually distant members of the final population that are refined.
    std_tolerance: admissible relative change of the standard errors when the refinement step is halved.
    confidence: confidence level of the diagnosis. adaptive: refine with an adaptive solver instead of fixed steps.
    """

    objectives: tuple[Objective, Objective] = ("correlation", "likelihood")
    search: EvolutionSettings = field(default_factory=EvolutionSettings)
    method: Literal["lm", "none"] = "lm"
    refine: RefineSettings = field(default_factory=RefineSettings)
    search_step: float | None = None
    refine_step: float | None = None
    search_tolerance: float = 3e-3
    refine_tolerance: float = 1e-5
    starts: int = 3
    std_tolerance: float = 5e-3
    confidence: float = 0.95
    adaptive: bool = False


def with_less_effort(settings: HybridSettings) -> HybridSettings:
    """Reduce the effort for an engine that evaluates every integration step in Python.

    The search gets larger tolerances. The refinement uses an adaptive solver unless a step is prescribed.
    """
    search = replace(
        settings.search,
        parameter_tolerance=max(settings.search.parameter_tolerance, SLOW_PARAMETER_TOLERANCE),
        cost_tolerance=max(settings.search.cost_tolerance, SLOW_COST_TOLERANCE),
    )
    rough = max(settings.search_tolerance, SLOW_SEARCH_TOLERANCE)
    return replace(settings, search=search, search_tolerance=rough, adaptive=settings.refine_step is None)
