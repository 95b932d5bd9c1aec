"""First-order influence of a component's discrepancy on the readings, about the trajectory predicted from earlier readings.

The linearised plant maps each regressor to readings. The part that constants and initial levels within their tolerances
can explain is projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.gap.candidate_fit import Fit, Fitter
from fdi_torch.gap.dataset import interpolate
from fdi_torch.gap.forcing import Forcing
from fdi_torch.gap.localization.component_regressors import (
    DiscrepancyModel,
    SignalRanges,
    Signals,
    discrepancy_model_at,
    reading_regressors,
)
from fdi_torch.gap.localization.regressors import time_functions
from fdi_torch.gap.marginal_likelihood import predicted_levels
from fdi_torch.plant.description import OUTSIDE, Sensor
from fdi_torch.plant.scales import time_scale
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint_collocation import JointCollocation, with_blanks
from fdi_torch.simulate.scan import product, scan_in_time

MOST_ROWS = 1000  # rows per channel; more samples are summed in groups, since no regressor is that fast
SAMPLES_A_STEP = 9  # fewest samples per step function of time


@dataclass(frozen=True)
class NormalEquations:
    """gram (M, M) = C'C and score (M,) = C'r of a component's columns C and the residual r, whitened by a fitter."""

    gram: Tensor
    score: Tensor


@dataclass(frozen=True)
class Discrepancy:
    """Influence of a component's regressors on the readings, columns (S, C, M), about a linearised trajectory."""

    columns: Tensor
    linearised: Linearised


@dataclass(frozen=True)
class Regressors:
    """Regressors of one component along one recording.

    flows (M, K) m^3/s; functions of time in_time (M', K); for a tank, areas (M'', K): changes of its level rate, m/s.
    """

    flows: Tensor
    in_time: Tensor
    areas: Tensor | None


@dataclass(frozen=True)
class RecordingLinearisation:
    """One recording linearised about levels (1, K+1, tanks). rows: its samples among all."""

    engine: Collocation
    theta: Tensor
    linearised: Linearised
    forcing: Forcing
    rows: slice

    @property
    def middle(self) -> Tensor:
        nodes = self.engine.experiment.nodes
        return 0.5 * (nodes[1:] + nodes[:-1])

    def to_readings(self, rates: Tensor) -> Tensor:
        """Map changes of the level rates (tanks, M, K) to changes of the readings (S, C, M)."""
        gain, transition = self.linearised.gain.permute(0, 2, 3, 1), self.linearised.transition.permute(0, 2, 3, 1)
        initial = rates.new_zeros(1, *rates.shape[:2])
        paths = scan_in_time(transition, rates.unsqueeze(0), initial, gain)
        return (
            self.engine.look(self.linearised.levels, self.theta).along(paths, [-1] * rates.shape[1])[0].permute(2, 0, 1)
        )

    def to_rates(self, weights: Tensor) -> Tensor:
        """The transpose of `to_readings`: weights (S, C, M) of the readings -> weights of the rates (tanks, M, K)."""
        tanks, columns = self.linearised.gain.shape[-1], weights.shape[-1]
        paths = weights.new_zeros(1, tanks, columns, self.linearised.levels.shape[1], requires_grad=True)
        readings = self.engine.look(self.linearised.levels, self.theta).along(paths, [-1] * columns)
        (by_path,) = torch.autograd.grad(readings, paths, weights.permute(1, 2, 0).unsqueeze(0))
        back, gain = self.linearised.transition.permute(0, 3, 2, 1).flip(-1), self.linearised.gain.permute(0, 3, 2, 1)
        by_level = scan_in_time(back, by_path[..., :-1].flip(-1), by_path[..., -1]).flip(-1)
        return product(gain, by_level[..., 1:])[0]


class DiscrepancyRegression:
    """Influence of the discrepancies of all components of a data set, about one fit.

    periods: of sinusoids, s. steps: number of step functions of time, over all recordings.
    """

    def __init__(self, fitter: Fitter, fit: Fit, periods: Sequence[float], steps: int) -> None:
        self.fitter, self.fit, self.periods = fitter, fit, tuple(periods)
        self.engine = fitter.engine(fit.candidate, list(fit.effect_values))
        self.theta, self.levels = fit.theta.unsqueeze(0), predicted_levels(fitter, fit)
        self.linearised = self.engine.linearise(self.theta, self.levels)
        self.pieces = self._pieces(replace(self.linearised, levels=self.levels))
        self._regressors: dict[str, list[Regressors]] = {}
        parts, samples = len(self.pieces), len(fitter.data.readings)
        self.steps = max(min(steps, samples // SAMPLES_A_STEP) // parts, 2)

    def of(self, place: str) -> Discrepancy:
        plant = self.fitter.data.plant
        sensors = [s.name for s in plant.sensors]
        if place in sensors:
            return self._sensor_discrepancy(sensors.index(place), plant.sensors[sensors.index(place)])
        return Discrepancy(self._columns(place), self.linearised)

    def _pieces(self, linearised: Linearised) -> list[RecordingLinearisation]:
        whole = self.engine
        parts = (
            whole.apart(self.theta, linearised)
            if isinstance(whole, JointCollocation)
            else [(whole, self.theta, linearised)]
        )
        pieces = []
        for rows, (engine, theta, linearised_part) in zip(self.fitter.data.rows, parts, strict=True):
            values = engine.network.bind(engine.space, theta.unsqueeze(-2))
            present = [p.prefix for p in engine.network.placements]
            path = linearised_part.levels[0].T.contiguous()
            forcing = Forcing(engine.network, present, values, path, engine.experiment)
            pieces.append(RecordingLinearisation(engine, theta, linearised_part, forcing, rows))
        return pieces

    def regressors(self, place: str) -> list[Regressors]:
        """Regressors of the component at a place along each recording."""
        if place not in self._regressors:
            self._regressors[place] = self._along_recordings(discrepancy_model_at(place, self.fitter.data.plant))
        return self._regressors[place]

    def _along_recordings(self, component: DiscrepancyModel) -> list[Regressors]:
        signals = [
            {n: x.reshape(-1).expand(len(p.middle)) for n, x in component.signals(p.forcing).items()}
            for p in self.pieces
        ]
        ends, regressors = SignalRanges(signals), []
        for piece, s in zip(self.pieces, signals, strict=True):
            step = piece.engine.experiment.steps
            in_time = [s[component.in_time] * c for c in self._time_functions(piece.middle, piece)]
            areas = torch.stack(component.areas(s, step, ends)) if component.areas else None
            regressors.append(Regressors(torch.stack(component.flows(s, step, ends)), torch.stack(in_time), areas))
        return regressors

    def _columns(self, place: str) -> Tensor:
        """Influence of the regressors of a component (S, C, M), not whitened."""
        component = discrepancy_model_at(place, self.fitter.data.plant)
        shared: list[Tensor] = []
        per_recording: list[Tensor] = []
        for piece, regressors in zip(self.pieces, self.regressors(place), strict=True):
            changes = [self._rate_changes(piece, component, flows) for flows in (regressors.flows, regressors.in_time)]
            if regressors.areas is not None:
                rates = regressors.areas.new_zeros(len(changes[0]), *regressors.areas.shape)
                rates[self.tank(component.target)] = regressors.areas
                changes.insert(0, rates)
            columns = piece.to_readings(torch.cat(changes, dim=1))
            shared.append(columns[..., : -len(regressors.in_time)])
            per_recording.append(columns[..., -len(regressors.in_time) :])
        return _concatenated(shared, per_recording)

    def _rate_changes(self, piece: RecordingLinearisation, component: DiscrepancyModel, flows: Tensor) -> Tensor:
        """Map flows (M, K) from source to target to changes of the level rates (tanks, M, K)."""
        inflows: list[Tensor | None] = [None] * len(self.fitter.data.plant.tanks)
        for end, sign in ((component.source, -1.0), (component.target, 1.0)):
            if end != OUTSIDE:
                inflows[self.tank(end)] = sign * flows
        return piece.forcing.by_inflows(inflows, len(flows))

    def _time_functions(self, time: Tensor, piece: RecordingLinearisation) -> list[Tensor]:
        return time_functions(time, float(piece.engine.experiment.nodes[-1]), self.periods, self.steps)

    def tank(self, name: str) -> int:
        return [t.name for t in self.fitter.data.plant.tanks].index(name)

    def _sensor_discrepancy(self, channel: int, sensor: Sensor) -> Discrepancy:
        """About the model's level of the sensor's tank, with all other tanks at their predicted levels."""
        levels = self.engine.simulate_tank(self.theta, self.levels, self.tank(sensor.tank))
        signals: list[Signals] = []
        first = 0
        for piece in self.pieces:
            nodes, times = piece.engine.experiment.nodes, piece.engine.experiment.sample_times
            tank_levels = levels[0, first : first + len(nodes), self.tank(sensor.tank)]
            signals.append(
                {"reading": sensor.gain * interpolate(times, nodes, tank_levels) + sensor.offset, "time": times}
            )
            first += len(nodes)
        ends = SignalRanges(signals)
        shared: list[Tensor] = []
        per_recording: list[Tensor] = []
        scale = time_scale(self.fitter.data.plant)
        for piece, s in zip(self.pieces, signals, strict=True):
            step = piece.engine.experiment.sample_intervals
            in_time = self._time_functions(s["time"], piece)
            for regressors, columns in ((reading_regressors(s, step, ends, scale), shared), (in_time, per_recording)):
                column = levels.new_zeros(len(step), self.fitter.data.readings.shape[1], len(regressors))
                column[:, channel] = torch.stack(regressors, dim=1)
                columns.append(column)
        return Discrepancy(_concatenated(shared, per_recording), self.engine.linearise(self.theta, levels))


def normal_equations(fitter: Fitter, fit: Fit, discrepancy: Discrepancy) -> NormalEquations:
    """Normal equations of a discrepancy, with the parameters of a fit projected out."""
    space, theta = fit.space, fit.theta
    residual, jacobian = fitter.white(discrepancy.linearised)
    scale, pull, off = fitter.priors(space, theta)
    group = max(len(residual[0]) // MOST_ROWS, 1)
    c = _grouped(fitter.whiten(discrepancy.columns), group).flatten(0, 1)
    r = _grouped(residual[0], group).flatten()
    j = _grouped(jacobian[0] * scale, group).flatten(0, 1)
    basis, _ = torch.linalg.qr(torch.cat([j, torch.diag(pull + 1e-9)]))
    remaining = torch.cat([torch.cat([c, r.unsqueeze(1)], dim=1), c.new_zeros(len(pull), c.shape[1] + 1)])
    remaining[len(r) :, -1] = -off
    remaining -= basis @ (basis.T @ remaining)
    products = remaining.T @ remaining
    return NormalEquations(products[:-1, :-1], products[:-1, -1])


def _concatenated(shared: Sequence[Tensor], per_recording: Sequence[Tensor]) -> Tensor:
    """Stack the recordings; columns of `own` belong to one recording each."""
    rows, widths = [], [o.shape[-1] for o in per_recording]
    for k, (s, o) in enumerate(zip(shared, per_recording, strict=True)):
        before, after = (o.new_zeros(*o.shape[:-1], sum(w)) for w in (widths[:k], widths[k + 1 :]))
        rows.append(torch.cat([s, before, o, after], dim=-1))
    return with_blanks(rows, dim=0)


def _grouped(x: Tensor, each: int) -> Tensor:
    """Sums (S / each, ...) of groups of samples of x (S, ...), scaled to unit variance."""
    whole = len(x) // each * each
    return x[:whole].reshape(-1, each, *x.shape[1:]).sum(dim=1) / each**0.5
