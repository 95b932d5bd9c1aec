"""Simulated readings of a block's trials, and the bounds of their estimation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.capacity import expect_room
from fdi_torch.estimate.batch_algebra import apply
from fdi_torch.estimate.information import Certainty, certainty
from fdi_torch.simulate.engine import Engine, Readings
from fdi_torch.simulate.simulated_recording import noise_level
from fdi_torch.study.study_plan import Block, Plan

# Noise (m) for which bounds are stated if the readings have none.
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
        zeros = torch.zeros_like(clean)
        return Trials(truth, clean, zeros, torch.full_like(clean[:, 0], NOMINAL_NOISE))
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
