"""What slips between a rig and its recording: a unit by powers of ten, two channels swapped, a clock, a sensor whose
readings have nothing to do with its level.

Each slip is a hypothesis that undoes itself in the recording, with nothing to fit but a delay. It is held against the
recording as it is, and against what one or two effects of the library make of that (`slip_evidence.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor

from fdi_torch.gap.evidence import log_prior
from fdi_torch.gap.fitting import Candidate, Fitter
from fdi_torch.gap.floor import Noise
from fdi_torch.gap.library import library_of
from fdi_torch.gap.screening import Option, options_of, screen
from fdi_torch.gap.slip_evidence import Run, laid_out, noise_of, run, thinned
from fdi_torch.gap.subject import between
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.plant.operating_range import operating_range_of_all, with_simulated_levels
from fdi_torch.recording import Recording

DECADES = (-3, -2, -1, 1, 2, 3)
"""Powers of ten by which a unit slips: millimetres taken for metres at most."""
ODDS = 0.02
"""That anything has slipped, shared by all that may; as an effect that the library lacks (`evidence.Odds`)."""
SURE = 0.95
FARTHEST = 0.25
"""Share of the recording by which a clock is off at most."""
CORRECTIONS = 4
"""Of a clock's delay, by Gauss and Newton."""
CLOSE = 0.05
"""Share of a sampling interval, below which a delay is corrected no more."""
FEW = 30
"""Evaluations of a fit of an effect at most: it is one of a dozen, and need not be found to the last digit."""
LOOK = 3
"""Evaluations that tell which power of ten is worth a whole fit."""
MOSTLY = 0.8
"""Share of the log-likelihood that a recording lacks, beyond which something explains most of it."""
RIVALS, TOGETHER = 6, 2
"""Effects that are fitted, by what they promise beside the likeliest so far, and how many act together."""


@dataclass(frozen=True)
class Slip:
    """What went wrong, with which channels, in a sentence that says what to do.

    silent: the channel (one sensor) tells nothing of its level. physical: a delay of the sensor itself does the same,
    so that the gap diagnosis must not refuse it.
    """

    channels: tuple[str, ...]
    text: str
    silent: bool = False
    physical: bool = False


@dataclass(frozen=True)
class _Hypothesis:
    slip: Slip
    log_weight: float


def slip_of(plant: PlantDescription, recording: Recording, constant: tuple[str, ...] = ()) -> Slip | None:
    """The likeliest slip, if something has slipped with 95 %.

    constant: columns of sensors that never move though noise should move them, or they may be clipped all along.
    """
    as_is = run(laid_out(plant, thinned(recording), noise_of(plant, recording)))
    count = len(plant.sensors) + len(plant.channels())
    prior = math.log(ODDS / (len(DECADES) * count + math.comb(count, 2) + 2 * len(plant.sensors) + 1))
    if as_is.most + prior < as_is.log_likelihood + _odds(SURE):
        return None  # not even a recording without any error would be believed
    found = list(_Hypotheses(plant, recording, as_is, constant, prior).each())
    rivals = [as_is.log_likelihood]
    if not found or not _likelier(found, rivals):
        return None
    silent = {c for h in found if h.slip.silent for c in h.slip.channels}
    for rival in _with_effects(as_is, {s.name for s in plant.sensors if s.column in silent}):
        rivals.append(rival)
        if not _likelier(found, rivals):
            return None
    return max(found, key=lambda h: h.log_weight).slip


def _odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


def _likelier(found: list[_Hypothesis], rivals: list[float]) -> bool:
    slipped = torch.logsumexp(torch.tensor([h.log_weight for h in found]), 0)
    return float(slipped - torch.logsumexp(torch.tensor(rivals), 0)) > _odds(SURE)


@dataclass(frozen=True)
class _Hypotheses:
    """Each that promises, beside the model of the recording as it is, to pay for its prior is run anew."""

    plant: PlantDescription
    recording: Recording
    as_is: Run
    constant: tuple[str, ...]
    prior: float

    def each(self) -> Iterator[_Hypothesis]:
        """Inputs last: each takes a run of its own, which is spared where a sensor explains most of what is wrong."""
        wrong, best = self.as_is.most - self.as_is.log_likelihood, -math.inf
        for make in (self._units, self._swapped, self._clocks, self._silent, self._of_inputs):
            if make == self._of_inputs and best > self.as_is.log_likelihood + MOSTLY * wrong:
                return
            for slip, weight in make():
                best = max(best, weight)
                yield _Hypothesis(slip, self.prior + weight)

    def _of_inputs(self) -> Iterator[tuple[Slip, float]]:
        yield from self._units_of_inputs()
        yield from self._swapped_inputs()

    def _run(self, corrected: Recording, look: bool = False) -> Run:
        """look: only nearly fitted."""
        case = laid_out(self.plant, thinned(corrected), noise_of(self.plant, corrected))
        return run(case, base=self.as_is, cap=LOOK, rounds=1) if look else run(case, base=self.as_is)

    def _weight(self, corrected: Recording) -> float:
        return self._run(corrected).log_likelihood

    def _column(self, sensor: int) -> int:
        return self.recording.output_names.index(self.plant.sensors[sensor].column)

    def _gain(self, sensor: int, readings: Tensor, mask: Tensor, model: Tensor) -> float:
        """Log-likelihood that a sensor gains where it reads this, and the model that, (S,) each."""
        case = self.as_is.case
        means, samples = case.means((readings - model).unsqueeze(1), mask.unsqueeze(1))
        left = float((samples * means**2).sum() / samples.sum().clamp(min=1.0))
        ratio = float(self.as_is.variance[sensor]) / max(left, float(case.noise[sensor]))
        return 0.5 * float(self.as_is.means[sensor]) * math.log(ratio)

    def _promises(self, *gains: float) -> bool:
        return sum(gains) + self.prior > 0.0

    def _units(self) -> Iterator[tuple[Slip, float]]:
        r, readings, model = self.recording, self.as_is.case.subject.readings, self.as_is.readings
        for i, sensor in enumerate(self.plant.sensors):
            mask = self.as_is.case.subject.mask[:, i]
            level, expected = (
                float((x[mask, i] - sensor.offset).abs().median()) if bool(mask.any()) else 0.0
                for x in (readings, model)
            )
            decade = round(math.log10(level / expected)) if level > 0.0 and expected > 0.0 else 0
            # The density of numbers that are k times another's: an error of a level is k times as large in them.
            wider = float(self.as_is.means[i]) * decade * math.log(10.0)
            gain = self._gain(i, readings[:, i] / 10.0**decade, mask, model[:, i]) - wider
            if decade in DECADES and self._promises(gain):
                outputs = r.outputs.clone()
                outputs[:, self._column(i)] /= 10.0**decade
                yield _wrong_unit(sensor.column, decade), self._weight(replace(r, outputs=outputs)) - wider

    def _units_of_inputs(self) -> Iterator[tuple[Slip, float]]:
        """Only where some level, or how it moves, is off by a quarter: a tenth of one of several flows is missed by
        more."""
        r, subject = self.recording, self.as_is.case.subject
        seen = torch.where(subject.mask, subject.readings, torch.nan)
        model = torch.where(subject.mask, self.as_is.readings, torch.nan)
        levels = [x.nanmean(dim=0) for x in (seen, model)]
        moves = [(x - x.nanmean(dim=0)).abs().nanmean(dim=0) for x in (seen, model)]
        off = [torch.log10((a / b).abs()).abs().nan_to_num(0.0).max() for a, b in (levels, moves)]
        if max(float(x) for x in off) < math.log10(1.25):
            return
        for channel in self.plant.channels():
            each: list[tuple[float, int, Recording]] = []
            for decade in DECADES:
                inputs = r.inputs.clone()
                inputs[:, r.input_names.index(channel)] /= 10.0**decade
                corrected = replace(r, inputs=inputs)
                each.append((self._run(corrected, look=True).log_likelihood, decade, corrected))
            _, decade, corrected = max(each, key=lambda found: found[0])
            yield _wrong_unit(channel, decade), self._weight(corrected)

    def _swapped(self) -> Iterator[tuple[Slip, float]]:
        r, subject, model = self.recording, self.as_is.case.subject, self.as_is.readings
        for (k, a), (n, b) in combinations(enumerate(self.plant.sensors), 2):
            gains = [
                self._gain(x, subject.readings[:, y], subject.mask[:, y], model[:, x]) for x, y in ((k, n), (n, k))
            ]
            if (a.unit, a.gain, a.offset) == (b.unit, b.gain, b.offset) and self._promises(*gains):
                turned = list(r.output_names)
                i, j = self._column(k), self._column(n)
                turned[i], turned[j] = turned[j], turned[i]
                yield _swap(a.column, b.column), self._weight(replace(r, output_names=tuple(turned)))

    def _swapped_inputs(self) -> Iterator[tuple[Slip, float]]:
        """The pair that explains most: a recording has only one."""
        units, r = self.plant.channel_units(), self.recording
        each: list[tuple[float, tuple[str, str], Recording]] = []
        for first, second in combinations(self.plant.channels(), 2):
            i, j = r.input_names.index(first), r.input_names.index(second)
            if units[first] == units[second] and not torch.equal(r.inputs[:, i], r.inputs[:, j]):
                turned = list(r.input_names)
                turned[i], turned[j] = turned[j], turned[i]
                corrected = replace(r, input_names=tuple(turned))
                each.append((self._run(corrected, look=True).log_likelihood, (first, second), corrected))
        if each:
            _, pair, corrected = max(each, key=lambda found: found[0])
            yield _swap(*pair), self._weight(corrected)

    def _clocks(self) -> Iterator[tuple[Slip, float]]:
        """All readings late or early, or those of one sensor; the delay by Gauss and Newton."""
        sensors = range(len(self.plant.sensors))
        interval = self.as_is.case.recording.interval
        for late in [list(sensors), *([i] for i in sensors if len(sensors) > 1)]:
            delay, gain = self._begin(late)
            if not self._promises(gain):
                continue
            corrected = self._run(self._earlier(late, delay))
            for _ in range(CORRECTIONS):
                more = _delay(corrected, late)
                delay += more
                corrected = self._run(self._earlier(late, delay))
                if abs(more) < CLOSE * interval:
                    break
            cost = 0.5 * math.log(float(corrected.means.sum()))
            columns = tuple(self.plant.sensors[i].column for i in late)
            yield _late(columns, delay, len(late) == len(sensors)), corrected.log_likelihood - cost

    def _earlier(self, late: list[int], delay: float) -> Recording:
        """Some sensors' readings by so many seconds earlier; what is then unknown does not count."""
        r = self.recording
        outputs, mask = r.outputs.clone(), r.mask.clone()
        for column in map(self._column, late):
            seen = mask[:, column].clone()
            times = r.time[seen]
            at = r.time + delay
            if len(times):
                outputs[:, column] = between(at, times, r.outputs[seen, column])
                mask[:, column] &= (at >= times[0]) & (at <= times[-1])
        return replace(r, outputs=outputs, mask=mask)

    def _begin(self, late: list[int]) -> tuple[float, float]:
        """The delay (s) by which readings follow the model best, in whole samples of the thinned recording, and what it
        gains."""
        case, model = self.as_is.case, self.as_is.readings[:, late]
        most = int(FARTHEST * len(model))
        mean_square = _mean_square(case.subject.readings[:, late], model, case.subject.mask[:, late], most)
        log_likelihood = -0.5 * (torch.log(mean_square + case.noise[late]) @ self.as_is.means[late])
        best = int(log_likelihood.argmax())
        return (best - most) * case.recording.interval, float(log_likelihood[best] - log_likelihood[most])

    def _silent(self) -> Iterator[tuple[Slip, float]]:
        """Sensors that scatter by more than their level moves, or that never move."""
        case, r = self.as_is.case, self.recording
        for i, sensor in enumerate(self.plant.sensors):
            still, noise = sensor.column in self.constant, float(noise_of(self.plant, r)[i])
            seen = case.subject.mask[:, i]
            if not bool(seen.any()) or not (still or noise > float(self.as_is.readings[:, i].std())):
                continue
            mask = r.mask.clone()
            mask[:, self._column(i)] = False
            rest = self._run(replace(r, mask=mask)).log_likelihood
            mean = case.subject.readings[seen, i].mean()
            gain = self._gain(i, case.subject.readings[:, i], seen, mean.expand(len(seen)))
            own = -0.5 * float(self.as_is.means[i] * torch.log(self.as_is.variance[i]))
            yield _follows_nothing(sensor, still), rest + own + gain


def _mean_square(readings: Tensor, model: Tensor, mask: Tensor, most: int) -> Tensor:
    """Mean square of readings[k + lag] - model[k] over the readings that count, (2 most + 1, C) for lags of -most to
    most samples, by Fourier transforms of (S, C) each."""
    center = torch.where(mask, readings, 0.0).sum(dim=0) / mask.sum(dim=0).clamp(min=1)
    x, m, keep = torch.where(mask, readings - center, 0.0), model - center, mask.to(readings.dtype)
    size = 2 * len(m)

    def correlated(a: Tensor, b: Tensor) -> Tensor:
        whole = torch.fft.irfft(torch.fft.rfft(a, size, dim=0) * torch.fft.rfft(b, size, dim=0).conj(), size, dim=0)
        return torch.cat([whole[size - most :], whole[: most + 1]])

    one = torch.ones_like(m)
    square = correlated(x**2, one) - 2.0 * correlated(x, m) + correlated(keep, m**2)
    return square.clamp(min=0.0) / correlated(keep, one).clamp(min=1.0)


def _delay(found: Run, late: list[int]) -> float:
    """By how much longer (s) these readings are late, to first order: r = -delay dm/dt, in units of each error."""
    case, model = found.case, found.readings[:, late]
    slope = torch.gradient(model, spacing=(case.recording.time,), dim=0)[0]
    mask, weight = case.subject.mask[:, late], 1.0 / found.variance[late]
    residual = torch.where(mask, case.subject.readings[:, late] - model, 0.0)
    slope = torch.where(mask, slope, 0.0)
    return -float((residual * slope * weight).sum() / (slope * slope * weight).sum().clamp(min=1e-300))


def _with_effects(as_is: Run, elsewhere: set[str]) -> Iterator[float]:
    """Weights of the recording as it is, with one effect of the library and with two, by a greedy search.

    elsewhere: places that have none.
    """
    case, plant = as_is.case, as_is.case.plant
    library = [p for p in library_of(plant) if not p.effect.quantizes and p.location not in elsewhere]
    known = {p.prefix for p in case.subject.believed}
    placements = [p for p in library if p.prefix not in known]
    parent = as_is
    for _ in range(TOGETHER):
        fit = parent.fit
        reach = with_simulated_levels(operating_range_of_all([case.recording], plant), plant, fit.near.levels[0])
        fitter = _fitter(parent)
        beside = [p for p in placements if (p.effect.name, p.location) not in fit.key]
        shown = screen(fitter, fit, options_of(beside, fitter, reach), pairs=False)
        best: dict[tuple[str, str], Option] = {}
        for k in torch.argsort(shown.gain, descending=True).tolist():
            best.setdefault(shown.options[k].cause, shown.options[k])
        runs: list[Run] = []
        for option in list(best.values())[:RIVALS]:
            start = fit.effect_values | dict(option.start)
            further = Candidate((*fit.candidate.placements, option.placement), (start,))
            runs.append(run(case, further, as_is, FEW))
            yield _weight_of(runs[-1], len(library))
        if not runs:
            return
        parent = max(runs, key=lambda each: each.log_likelihood)


def _weight_of(found: Run, choices: int) -> float:
    shape = 0.5 * len(found.fit.effect_values) * math.log(float(found.means.sum()))
    return found.log_likelihood - shape + log_prior(found.fit.key, choices)


def _fitter(found: Run) -> Fitter:
    """Under the errors that a run leaves."""
    subject = found.case.subject
    each = torch.sqrt(found.variance * subject.mask.sum(dim=0).clamp(min=1) / found.means.clamp(min=1.0))
    return Fitter(subject, Noise(each, torch.zeros_like(each)))


def _wrong_unit(channel: str, decade: int) -> Slip:
    times = f"{10 ** abs(decade)} times too {'large' if decade > 0 else 'small'}"
    fix = f"columns: {{{channel}: {{unit: ...}}}}"
    return Slip((channel,), f"{channel}: its unit seems wrong, for its numbers are {times}; give it under {fix}")


def _swap(a: str, b: str) -> Slip:
    fix = f"columns: {{{a}: {{column: {b}}}, {b}: {{column: {a}}}}}"
    return Slip((a, b), f"{a} and {b} seem to be swapped; say which column is which, as in {fix}")


def _late(columns: tuple[str, ...], delay: float, everything: bool) -> Slip:
    what = "the readings" if everything else ", ".join(columns)
    beside = "the inputs" if everything else "the other channels"
    text = (
        f"{what}: the clock seems to run {abs(delay):.3g} s {'behind' if delay > 0 else 'ahead of'} that of {beside}; "
        "give each file's shift under columns: {t: {shift: ...}}"
    )
    return Slip(("all",) if everything else columns, text, physical=delay > 0 and not everything)


def _follows_nothing(sensor: Sensor, still: bool) -> Slip:
    if still:
        return Slip((sensor.column,), f"{sensor.column} is stuck", True)
    text = (
        f"{sensor.column}: its readings do not follow the level of {sensor.tank}: they scatter by more than that "
        "moves; check its wiring, or leave the sensor out of the plant file"
    )
    return Slip((sensor.column,), text, True)
