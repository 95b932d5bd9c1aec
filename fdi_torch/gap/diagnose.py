"""The gap diagnosis: noise floor, recalibration, which, where; then the answer, with the hold-out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from fdi_torch.gap.answer import Answer, CauseName, Explanation, Verdict
from fdi_torch.gap.answering import answered
from fdi_torch.gap.case import PLAIN, Case, Settings, case_of
from fdi_torch.gap.evidence import opinions, plainest, temperature
from fdi_torch.gap.finding import ALARM, UNEXPLAINED, Finding, Weighed, chance, in_order, whole_gap
from fdi_torch.gap.fitting import Candidate, Fit, Fitter, left_open
from fdi_torch.gap.floor import Noise, estimate_noise, lattice_step, with_rounding
from fdi_torch.gap.freeform import fitted_free_form
from fdi_torch.gap.library import canonical, possible_places, stacked
from fdi_torch.gap.limits import unclipped, with_clipped_noise
from fdi_torch.gap.screening import options_of
from fdi_torch.gap.strays import most_astray
from fdi_torch.gap.stretches import chosen
from fdi_torch.gap.subject import Subject
from fdi_torch.gap.tied import tied
from fdi_torch.gap.where.components import balance_of
from fdi_torch.gap.where.suspects import Suspect, parted, suspects
from fdi_torch.gap.which import Search, search
from fdi_torch.plant.description import PlantDescription
from fdi_torch.plant.reach import reach_of_all, with_levels
from fdi_torch.recording import Recording

CONTENT = 0.95
PATIENT = 40  # rounds for the recalibration, on which all else rests
LEFT_SHARE, LEFT_LEAST = 2e-3, 150.0  # share of the gap, and chi-square units, worth asking other forms about
AMONG_OTHERS_SHARE = 3e-3  # the same where one of the effects found is at the likeliest place
SAME_PLACE_SHARE = 3e-2  # the same where one effect at the likeliest place leaves it: its equation is a little off
FAR_BETTER = 0.35
DECISIVE = 120.0  # nats by which a place is ahead of all that are named, to be the likelier one whatever the gap
DECISIVE_SHARE = 1e-2  # of the gap that it may leave then beyond what the effects leave
DOUBT = 0.1  # that of two effects at one place one is there only because the other's equation is a little off
Tell = Callable[[float, str], None]


def diagnose(
    plant: PlantDescription,
    recording: Recording | Sequence[Recording],
    holdout: Recording | Sequence[Recording] | None = None,
    settings: Settings = PLAIN,
    tell: Tell = lambda share, text: None,
) -> Answer:
    """What keeps the plant file from explaining the recording, or several recordings by the same causes.

    Hold-outs only measure how far the gap closes.
    """
    recordings = (recording,) if isinstance(recording, Recording) else tuple(recording)
    holdouts = () if holdout is None else (holdout,) if isinstance(holdout, Recording) else tuple(holdout)
    return solved(case_of(plant, recordings, holdouts, settings), tell)


def solved(case: Case, tell: Tell = lambda share, text: None) -> Answer:
    """The diagnosis, stage by stage."""
    subject, library, plant, told = case.subject, case.library, case.subject.plant, case.told
    tell(0.05, "noise floor and recalibration")
    fitter, null, lattice = _recalibrated(subject)
    reach = with_levels(reach_of_all(case.recordings, plant), plant, null.near.levels[0])
    tell(0.2, "which effect")
    known = {p.prefix for p in told} | {name.rpartition(".")[0] for name in subject.nuisance}
    options = options_of([p for p in library if not p.effect.rounds and p.prefix not in known], fitter, reach)
    found = search(fitter, null, options, case.most)
    tell(0.6, "where")
    if case.cross_validate:
        tell(0.4, "which predicts stretches that it was not fitted to")
        choice = chosen(fitter, found, plant, reach)
        found, weighed = choice.search, choice.weighed
    else:
        weighed = _weighed(fitter, found, len(library), plant)
    places = _places(fitter, found, weighed.fits[0], plant)
    rounded = [("sensor_quantization", s.name) for s, step in zip(plant.sensors, lattice, strict=True) if step > 0.0]
    rounded = [c for c in rounded if any((p.effect.name, p.location) == c for p in library)]
    rounded += [(p.effect.name, p.location) for p in told]
    unknown = None
    # A gap without a name is a gap: hardly any is such that nothing in the library helps. Slow noise is.
    alarmed = chance(found) < ALARM
    if not case.named_only and alarmed and _unnamed(fitter, weighed.fits[0], found, places):
        places = parted(fitter, found.null, places)
        unknown = fitted_free_form(fitter, found.null, places[0].location, places[0].periods, reach)
    standing = _content(weighed.explanations)
    verdict: Verdict = "unknown" if unknown else _verdict(standing, rounded)
    nowhere = places[0].leaves > 0.5 * whole_gap(fitter, found)
    if (verdict == "no_gap" or (unknown and nowhere)) and (straying := most_astray(case.strays[0])):
        # Nothing else is wrong, or nothing that any place could do: no effect of the library makes a reading jump.
        places = [Suspect(straying, 0.0, 0.0), *(replace(s, leaves=math.inf) for s in places if s.location != straying)]
        unknown, verdict = fitted_free_form(fitter, found.null, straying, (), reach), "unknown"
    finding = Finding(
        fitter, library, reach, found, places, weighed, standing, unknown, verdict, rounded, lattice, told, case.strays
    )
    tell(0.8, "hold-out")
    return answered(finding, case.held)


def _places(fitter: Fitter, found: Search, named: Fit, plant: PlantDescription) -> list[Suspect]:
    """Every place with what it leaves open, the likeliest first; looked at closely where the library leaves much."""
    gap, left = whole_gap(fitter, found), left_open(fitter, named)
    much = left > UNEXPLAINED * gap > 0.0
    closely = left > max(LEFT_SHARE * gap, LEFT_LEAST) or _scattered(named) or bool(stacked(named.key))
    return suspects(fitter, found.null, possible_places(plant), waves=much, closely=closely)


def _unnamed(fitter: Fitter, named: Fit, found: Search, places: Sequence[Suspect]) -> bool:
    """Whether the likeliest place alone does what no effect of the library does.

    Equations that differ a little leave a little open; where one place alone does far better than all that has a name,
    or nothing named does, it has no name. So too where it does what otherwise takes effects at several other places,
    or a coincidence of them; and where two forms of one law are needed at one place: the law there is then a third one.
    """
    place, gap, left = places[0], whole_gap(fitter, found), left_open(fitter, named)
    free = place.leaves
    if stacked(named.key):
        return True
    coincidence = _coincidence(fitter, named, place)
    if left < LEFT_LEAST and not (_scattered(named) or coincidence):
        return False
    nothing_named = left > UNEXPLAINED * gap
    there = [at == place.location for _, at in named.key]
    share = SAME_PLACE_SHARE if there == [True] else AMONG_OTHERS_SHARE if any(there) else LEFT_SHARE
    worth_asking = max(share * gap, LEFT_LEAST)
    far_better = free < FAR_BETTER * left and left - free > worth_asking
    little = 0.5 * max(LEFT_SHARE * gap, LEFT_LEAST)
    single = min((left_open(fitter, f) for f in found.fits if len(f.key) == 1), default=gap)
    elsewhere = _scattered(named) and not any(there)
    as_well, needed = free < left + little, single > left + 4.0 * little
    # A small gap is closed by many forms of one place as well as by a few effects at several, unless theirs cannot.
    large = LEFT_SHARE * gap > LEFT_LEAST
    theirs = [s.evidence for s in places if s.location in {at for _, at in named.key}]
    if elsewhere and max(theirs, default=0.0) < -DECISIVE:
        large, as_well = True, free < left + max(little, DECISIVE_SHARE * gap)
    one_for_many = as_well and needed and ((large and elsewhere) or coincidence)
    return nothing_named or far_better or one_for_many


def _coincidence(fitter: Fitter, named: Fit, place: Suspect) -> bool:
    """Whether several causes, each at a moment of its own, stand in for one place: in its balance, or all elsewhere."""
    plant, moments = fitter.subject.plant, [at for _, at in tied(named)]
    balance = balance_of(place.location, plant)
    here = [at for at in moments if at == place.location or (balance and balance_of(at, plant) == balance)]
    elsewhere = all(at != place.location for _, at in named.key)
    return len(moments if elsewhere else here) > 1


def _scattered(fit: Fit) -> bool:
    """Whether it takes effects at more than one place."""
    return len({place for _, place in fit.key}) > 1


def _recalibrated(subject: Subject) -> tuple[Fitter, Fit, list[float]]:
    """The noise of each channel, the recalibrated plant under it, and the step of each rounded channel."""
    channels = len(subject.plant.sensors)
    spread = subject.readings.nan_to_num().std(dim=0).clamp(min=1e-9)
    first = Fitter(subject, Noise(1e-2 * spread, torch.zeros(channels, dtype=spread.dtype)))
    null = first.fit(Candidate(), rounds=PATIENT)
    residual = subject.readings - null.near.readings[0]
    noise = estimate_noise(residual, subject.mask, rows=subject.rows)
    values = [subject.readings[subject.mask[:, c], c] for c in range(channels)]
    lattice = [lattice_step(v, float(noise.std[c])) for c, v in enumerate(values)]
    noise = estimate_noise(residual, subject.mask, [step > 0.0 for step in lattice], subject.rows)
    noise = unclipped(noise, subject, null.near.readings[0])
    fitter = Fitter(with_clipped_noise(subject, null, noise), with_rounding(noise, lattice, null.near.readings[0]))
    return fitter, fitter.fit(Candidate(), null, rounds=PATIENT), lattice


def _weighed(fitter: Fitter, found: Search, choices: int, plant: PlantDescription) -> Weighed:
    """All fits of the search by their probabilities; names of one thing count once."""
    gap = found.null.cost - found.best.cost
    heat = temperature(gap, left_open(fitter, plainest(found.fits, gap)))
    best: dict[frozenset[CauseName], Fit] = {}
    for fit in found.fits:
        key = frozenset(canonical(c, plant) for c in fit.key)
        if key not in best or fit.cost < best[key].cost:
            best[key] = fit
    weights = _doubted(opinions(fitter, list(best.values()), heat, choices), list(best.values()), gap)
    ranked = sorted(zip(weights, best.values(), strict=True), key=lambda item: -item[0])
    return Weighed(tuple(Explanation(in_order(f), w) for w, f in ranked), tuple(f for _, f in ranked))


def _doubted(weights: list[float], fits: Sequence[Fit], gap: float) -> list[float]:
    """The likeliest explanation gives some of its weight to one with an effect less, where that stands beside another
    at the same place and closes no more than a law that is a little off leaves: it may only take up its misfit. Nearly
    all of it where both are forms of one law.
    """
    top = max(range(len(fits)), key=lambda i: weights[i])
    alike = stacked(fits[top].key)
    crowded = alike or {c for c in fits[top].key if sum(place == c[1] for _, place in fits[top].key) > 1}
    plainer, little = {fits[top].key - {c} for c in crowded}, SAME_PLACE_SHARE * gap
    little = max(little, LEFT_LEAST) if alike else little
    rivals = [i for i, f in enumerate(fits) if f.key in plainer and f.cost - fits[top].cost < little]
    if not rivals:
        return weights
    rival = min(rivals, key=lambda i: fits[i].cost)
    doubt = 1.0 - DOUBT if alike else DOUBT
    given = max(doubt - weights[rival], 0.0) * weights[top]
    return [w + given * ((i == rival) - (i == top)) for i, w in enumerate(weights)]


def _content(explanations: Sequence[Explanation]) -> list[Explanation]:
    """The fewest explanations that hold 95 % together."""
    kept, held = [], 0.0
    for explanation in explanations:
        kept.append(explanation)
        held += explanation.probability
        if held >= CONTENT:
            break
    return kept


def _verdict(standing: Sequence[Explanation], rounded: Sequence[CauseName]) -> Verdict:
    if not standing[0].causes and not rounded:
        return "no_gap"
    return "named" if len(standing) == 1 else "ambiguous"
