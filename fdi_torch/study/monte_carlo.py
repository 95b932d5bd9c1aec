"""Estimation of all trials of a block at once: their simulated readings, search, refinement from coarse to fine steps,
and bounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.device import on_its_device
from fdi_torch.estimate.batch_algebra import apply
from fdi_torch.estimate.evolution import distant_members, evolve
from fdi_torch.estimate.information import Certainty, certainty
from fdi_torch.estimate.levenberg_marquardt import RefineSettings, levenberg_marquardt
from fdi_torch.estimate.linearisation import CONVERGED, STATUSES, Refined
from fdi_torch.estimate.misfit import UNEXPLAINED_RATIO
from fdi_torch.estimate.objectives import OBJECTIVES, Objective, Problem, Term, spread_of
from fdi_torch.sample_noise import sample_noise
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.simulate.simulated_recording import constant_outputs, noise_level
from fdi_torch.study.study_plan import Block, Plan

# Noise of the level (m) for which bounds are stated if the readings have none.
NOMINAL_NOISE = 1e-3


@dataclass(frozen=True)
class Trials:
    """truth (B, P), readings (B, S, C), the noise in them (B, S, C) and its standard deviation (B, C), SI."""

    truth: Tensor
    readings: Tensor
    noise: Tensor
    std: Tensor


def make_trials(plan: Plan, block: Block) -> Trials:
    """Noise-free readings at fine steps, plus each trial's noise."""
    setting = plan.settings[block.setting]
    readings = sum(part.outputs.numel() for part in plan.fitting.recordings)
    trials = block.last - block.first
    expect_room(3.0 * trials * readings, f"{trials:.3g} trials at once of {readings:.3g} readings", "lower study.block")
    truth = setting.faults[block.first : block.last]
    clean = _clean(plan.fitting.engines(plan.method.data_step)[0], truth)
    if setting.snr_db is None:
        gains = clean.new_tensor([abs(sensor.gain) for sensor in plan.fitting.plant.sensors])
        return Trials(truth, clean, torch.zeros_like(clean), (NOMINAL_NOISE * gains).expand_as(clean[:, 0]))
    if constant := constant_outputs(clean, plan.fitting.plant, plan.snr_definition):
        raise ValueError(
            f"study.snr_db: expected outputs that vary in every trial, got a constant {constant[0]}; change "
            "simulate.inputs, or leave its sensor out of the plant file"
        )
    std = noise_level(clean, setting.snr_db, plan.snr_definition)
    noise = plan.noise(block, tuple(clean.shape[1:])) * std[:, None, :]
    return Trials(truth, clean + noise, noise, std)


def _clean(engine: Engine, truth: Tensor) -> Tensor:
    """Noise-free readings (B, S, C); a fault that all trials have in common is simulated once."""
    if bool((truth == truth[:1]).all()):
        return engine.readings(truth[:1]).expand(len(truth), -1, -1)
    return engine.readings(truth)


@dataclass(frozen=True)
class Limits:
    """Bounds of unbiased estimation at the truth of each trial, (B, P) each.

    bound: Cramer-Rao bound with known initial levels and noise level; infinite for an undetermined parameter.
    correlation_bound: the same if gain and offset of each channel are unknown, as for the correlation objective.
    linearised: theta_0 + (J' W J)^-1 J' W noise, the efficient estimator of the linearised model on the same draws; NaN
    where the covariance is not defined.
    """

    bound: Tensor
    correlation_bound: Tensor
    linearised: Tensor


def limits(engine: Engine, trials: Trials) -> Limits:
    """Cramer-Rao bounds of all trials, and the linearised efficient estimator on their noise."""
    predicted = engine.readings(trials.truth)
    shifted = predicted + trials.noise
    gram = engine.gram(trials.truth[:, None], Readings(shifted, torch.ones_like(shifted)))[:, 0]
    weight = (trials.std**-2)[..., None, None]
    information, score = _summed(weight * gram[..., :-3, :-3]), _summed(weight * gram[..., :-3, -3:-2])[..., 0]
    joint = certainty(information)
    correlation_std = _without_gain_and_offset(engine, trials, predicted).std
    return Limits(joint.std, correlation_std, trials.truth + apply(joint.covariance, score))


def _without_gain_and_offset(engine: Engine, trials: Trials, predicted: Tensor) -> Certainty:
    """Certainty after projecting a constant and the prediction itself out of each channel's Jacobian."""
    gram = engine.gram(trials.truth[:, None], Readings(predicted, torch.ones_like(predicted)))[:, 0]
    count = gram[..., -1:, -1:]
    centred = gram - gram[..., :, -1:] * gram[..., -1:, :] / count
    along, power = centred[..., :-3, -2], centred[..., -2, -2]
    varies = power > 0
    share = along / torch.where(varies, power, 1.0)[..., None]
    projected = centred[..., :-3, :-3] - along[..., :, None] * share[..., None, :]
    return certainty(_summed((trials.std**-2)[..., None, None] * projected))


def _summed(per_channel: Tensor) -> Tensor:
    """(B, C, ...) -> (B, ...), summed channel by channel in a fixed order for reproducibility."""
    total = per_channel[:, 0]
    for channel in per_channel.unbind(1)[1:]:
        total = total + channel
    return total


# Residuals within this share of a channel's standard deviation are attributed to the integration steps.
STEP_SHARE = 1e-4
# The sum of correlations has a standard error of 1e-8 at an SNR of 50 dB, a hundred times this tolerance and more.
CORRELATION_TOLERANCE = 1e-13


@dataclass(frozen=True)
class Trial:
    """Result of one trial as logged. numbers: arrays over the parameters or sensors, or single numbers, SI."""

    number: int
    setting: str
    status: str
    numbers: dict[str, list[float] | float]


@on_its_device
def run_block(plan: Plan, block: Block) -> list[Trial]:
    """Estimate every trial of a block with each requested estimator."""
    trials = make_trials(plan, block)
    data = Readings(trials.readings, torch.ones_like(trials.readings))
    fits = Fits(plan, data)
    members = fits.searched(plan.search_seeds(block))
    boxed = fits.searched_again(fits.refined(members), plan, block)
    estimators = plan.method.estimators
    results: dict[str, Tensor] = {"truth": trials.truth}
    status = boxed
    if "boxed" in estimators:
        results |= {"boxed": boxed.theta, "boxed_std": fits.standard_errors(boxed)}
    if "free" in estimators:
        status = fits.unbounded(boxed.theta)
        results |= {"free": status.theta, "free_std": fits.standard_errors(status)}
    if "correlation" in estimators:
        results["correlation"] = fits.unbounded(boxed.theta, "correlation").theta
    if "search" in estimators:
        results["search"] = members[:, 0]
    limit = limits(fits.engines[-1], trials)
    results |= {"bound": limit.bound, "correlation_bound": limit.correlation_bound}
    if "linearised" in estimators:
        results["linearised"] = limit.linearised
    results |= {"rho": fits.correlations(boxed.theta), "noise": trials.std}
    return _records(plan, block, results, status)


def run_blocks(plan: Plan, blocks: Iterable[Block]) -> Iterator[list[Trial]]:
    """Compute the blocks one after the other in this process."""
    for block in blocks:
        yield run_block(plan, block)


def _records(plan: Plan, block: Block, results: dict[str, Tensor], refined: Refined) -> list[Trial]:
    columns = {name: values.tolist() for name, values in results.items()}
    columns["cost"] = refined.cost.tolist()
    columns["iterations"] = [float(n) for n in refined.iterations.tolist()]
    name, statuses = plan.settings[block.setting].name, refined.statuses()
    return [
        Trial(number, name, statuses[i], {key: values[i] for key, values in columns.items()})
        for i, number in enumerate(block.numbers)
    ]


class Fits:
    """The estimates of B simulated trials from their readings, with one engine for each integration step."""

    def __init__(self, plan: Plan, data: Readings) -> None:
        self.method, self.fitting, self.data = plan.method, plan.fitting, data
        self.low, self.high = plan.fitting.space.low(), plan.fitting.space.high()
        self.engines: list[Engine] = [plan.fitting.engines(step)[0] for step in plan.method.steps]

    def searched(
        self, seeds: Int[Tensor, " B"], lanes: Int[Tensor, " B"] | None = None, again: int = 0
    ) -> Float[Tensor, "B K P"]:
        """The best K parameter vectors of a global search for each trial, far apart from each other.

        Repeated searches alternate between the objectives, because their best basins may differ: the correlation is
        insensitive to gain and offset.
        """
        every, method = self.method.search_every, self.method
        data = self.data if lanes is None else self.data.of(lanes)
        thinned = Readings(data.values[:, ::every], data.weight[:, ::every])
        recordings = tuple(r.every(every) for r in self.fitting.recordings)
        engine = replace(self.fitting, recordings=recordings).engines(method.search_step)[0]
        first = OBJECTIVES.index(method.objective)
        problem = Problem(self.fitting.space, [Term(engine, thinned)], OBJECTIVES[(first + again) % len(OBJECTIVES)])
        low, high = (bound.expand(len(seeds), -1) for bound in (self.low, self.high))
        result = evolve(problem.cost, low, high, method.search, seeds)
        return distant_members(result.population, result.cost, self.high - self.low, method.starts)

    def refined(self, starts: Float[Tensor, "B K P"], lanes: Int[Tensor, " B"] | None = None) -> Refined:
        """Levenberg-Marquardt within the box from every start; the best result continues at finer steps."""
        best = starts
        for engine in self.engines:
            refined = self._refine(engine, best, self.low, self.high, lanes=lanes)
            chosen = refined.best()
            best = chosen.theta[:, None]
        return chosen

    def searched_again(self, fit: Refined, plan: Plan, block: Block) -> Refined:
        """Search again for trials whose residuals are larger than their noise, and keep the better fit."""
        for again in range(1, plan.method.searches):
            lanes = self._unexplained(fit.theta).nonzero()[:, 0]
            if not len(lanes):
                break
            other = self.refined(self.searched(plan.search_seeds(block, again)[lanes], lanes, again), lanes)
            better = other.cost < fit.cost[lanes]
            values = {n: v[better] for n, v in vars(other).items() if v is not None}
            fit = fit.file(lanes[better], **values)
        return fit

    def unbounded(self, theta: Float[Tensor, "B P"], objective: Objective = "likelihood") -> Refined:
        """Levenberg-Marquardt at the finest step without bounds, from theta."""
        everywhere = torch.full_like(self.low, torch.inf)
        settings = self.method.refine
        if objective == "correlation":
            settings = replace(settings, decrease_tolerance=CORRELATION_TOLERANCE)
        refined = self._refine(self.engines[-1], theta[:, None], -everywhere, everywhere, objective, settings)
        return refined.best()

    def standard_errors(self, fit: Refined) -> Float[Tensor, "B P"]:
        """Standard errors from the curvature of the likelihood; 0 where a bound is active."""
        return certainty(fit.curvature, held=fit.held).std

    def correlations(self, theta: Float[Tensor, "B P"]) -> Float[Tensor, "B C"]:
        """Correlation of each channel at theta."""
        problem = Problem(self.fitting.space, [Term(self.engines[-1], self.data)])
        return problem.correlations(theta[:, None], torch.arange(len(theta)))[:, 0]

    def _refine(
        self,
        engine: Engine,
        starts: Tensor,
        low: Tensor,
        high: Tensor,
        objective: Objective = "likelihood",
        settings: RefineSettings | None = None,
        lanes: Tensor | None = None,
    ) -> Refined:
        data = self.data if lanes is None else self.data.of(lanes)
        problem, each = Problem(self.fitting.space, [Term(engine, data)], objective), starts.shape[1]
        return levenberg_marquardt(
            lambda theta, members: problem.linearise(theta, members // each),
            starts,
            low,
            high,
            settings or self.method.refine,
        )

    def _unexplained(self, theta: Float[Tensor, "B P"]) -> Bool[Tensor, " B"]:
        """Whether residuals exceed the sample-to-sample noise in any channel."""
        squares = self.engines[-1].moments(theta[:, None], self.data)[:, 0, :, 1]
        count = self.data.count
        noise = torch.stack([sample_noise(v, w) for v, w in zip(self.data.values, self.data.weight, strict=True)])
        allowed = UNEXPLAINED_RATIO * noise + STEP_SHARE * (spread_of(self.data) / count).sqrt()
        return ((squares / count).sqrt() > allowed).any(-1)


def is_converged(status: str) -> bool:
    return status == STATUSES[CONVERGED]
