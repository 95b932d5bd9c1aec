"""The models whose free runs on a hold-out are compared: as believed, recalibrated, with the causes, with the causes
but other constants, and the ceiling.

The ceiling adds, to the causes, free functions of the guilty components' own variables: what no better equation of
these components could close either, as far as it keeps no memory. Its course in time belongs to the recording's clock
and stays out.
"""

from __future__ import annotations

from collections.abc import Mapping

from fdi_torch.gap.closure import Model, model_of
from fdi_torch.gap.coefficients import coefficients_of, lasting
from fdi_torch.gap.finding import Finding
from fdi_torch.gap.fitting import Fit
from fdi_torch.gap.freeform import free_form

FROZEN = {"recalibrated": "augmented_on_recalibrated", "nominal": "augmented_on_nominal"}


def models_of(found: Finding) -> dict[str, Model]:
    """All models by the names of the answer."""
    best = found.best
    return {
        "nominal": Model(),
        "recalibrated": model_of(found.null),
        "augmented": model_of(best),
        FROZEN["recalibrated"]: Model(best.candidate.placements, constants_of(found.null) | best.effect_values),
        FROZEN["nominal"]: Model(best.candidate.placements, best.effect_values),
        "ceiling": ceiling_of(found),
    }


def constants_of(fit: Fit) -> dict[str, float]:
    """The calibration constants of a fit and what it refitted of effects that the plant file has, without start levels
    and what further recordings have for themselves.
    """
    new = {p.prefix for p in fit.candidate.placements}
    lasting_names = [n for n in fit.space.names if "@" not in n and not n.endswith(".start_level")]
    return {n: fit.values[n] for n in lasting_names if n.rpartition(".")[0] not in new}


def ceiling_of(found: Finding) -> Model:
    """The best explanation with free functions beside it, where it has a name; else it is the free form itself."""
    best, plant = found.best, found.fitter.subject.plant
    if found.unnamed:
        return model_of(best)
    free = lasting([p for place in guilty_places(found) for p in free_form(place, plant, found.reach)])
    taken: Mapping[str, float] = coefficients_of(found.fitter, best, free, found.reach).by_name()
    return Model((*best.candidate.placements, *free), {**best.values, **taken})


def guilty_places(found: Finding) -> list[str]:
    """Where the best explanation's causes are; the likeliest place where it has none."""
    places = list(dict.fromkeys(p.location for p in found.best.candidate.placements))
    return places or [found.posterior.places[0][0]]
