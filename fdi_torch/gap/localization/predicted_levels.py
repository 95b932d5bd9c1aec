"""Levels predicted from earlier readings, about which a plant is linearised for its discrepancies.

An innovation is independent of all that follows from earlier readings (Ljung, 1999, "System identification", section
3.2). Smoothed levels contain the disturbance of the same step; functions of them, in particular of their rates, would
explain random flows.

The Kalman filter that predicts the levels needs a linearised plant: about the trajectory of a fit or, if a wrong law
leads this trajectory far away from the readings, for example to a dry tank, about the levels that the sensors measure.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fdi_torch.estimate.noise_model import StateNoise
from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.marginal_likelihood import estimate_disturbances, with_disturbances
from fdi_torch.plant.inverted_sensor import levels_from_readings
from fdi_torch.simulate.linearised import Linearised
from fdi_torch.simulate.resampling import interpolate


@dataclass(frozen=True)
class LevelFilter:
    """The filter that predicts levels. noise: of flows and sensors, as estimated without a discrepancy.

    along (1, K+1, n): the levels about which the filter is linearised, m; None: the trajectory of the fit.
    """

    noise: StateNoise
    along: Tensor | None = None

    def levels(self, fitter: Fitter, fit: Fit) -> Tensor:
        """States (1, K+1, n) of all recordings at the parameters of a fit."""
        linearised = fit.linearised if self.along is None else _linearised(fit, self.along)
        data, levels = fitter.data, linearised.levels.clone()
        whitening = with_disturbances(fitter, fit, self.noise, linearised).whitening
        assert whitening is not None
        correction = whitening.predicted(data.readings - linearised.readings[0])
        first = 0
        for part, rows in zip(data.parts, data.rows, strict=True):
            nodes = part.experiment.nodes
            at_nodes = [interpolate(nodes, part.experiment.sample_times, x) for x in correction[rows].unbind(1)]
            levels[0, first : first + len(nodes)] += torch.stack(at_nodes, dim=1)
            first += len(nodes)
        levels[..., : len(data.plant.tanks)].clamp_(min=0.0)
        return levels


def measured_filter(fitter: Fitter, fit: Fit, noise: StateNoise) -> LevelFilter:
    """The filter about the measured levels, with the noise that is most likely there. noise: initial values."""
    along = measured_levels(fitter, fit)
    return LevelFilter(estimate_disturbances(fitter, fit, _linearised(fit, along), start=noise).noise, along)


def _linearised(fit: Fit, levels: Tensor) -> Linearised:
    """The plant at the parameters of a fit, linearised about levels."""
    return fit.engine.linearise(fit.theta.unsqueeze(0), levels)


def measured_levels(fitter: Fitter, fit: Fit) -> Tensor:
    """States (1, K+1, n) of all recordings with the levels that the readings of one sample before show; those of the
    fit where none do.

    A plant that is linearised about a reading contains its noise, and predicts the reading too well.
    """
    data, tanks, measured = fitter.data, len(fitter.data.plant.tanks), []
    pieces = fit.pieces(fit.linearised)
    for (engine, theta, linearised), rows in zip(pieces, data.rows, strict=True):
        experiment, states = engine.experiment, linearised.levels[0].unbind(-1)
        nodes, times = experiment.nodes, torch.cat([experiment.sample_times[1:], experiment.sample_times[-1:]])
        readings = []
        for y, valid in zip(data.readings[rows].unbind(1), data.mask[rows].unbind(1), strict=True):
            known = bool(valid.any())
            readings.append(interpolate(nodes, times[valid], y[valid]) if known else torch.full_like(nodes, torch.nan))
        values = engine.network.bind(engine.space, theta)
        levels = levels_from_readings(engine.network, readings, states[:tanks], nodes, values)
        measured.append(torch.stack([*levels, *states[tanks:]], dim=-1))
    return torch.cat(measured).unsqueeze(0)
