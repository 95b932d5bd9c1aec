"""What the forms of a component's discrepancy do to the readings, to first order about the trajectory that was read.

The linearised plant turns each form into readings; what constants and start levels within their tolerances could do as
well is taken out of them.
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
    component_at,
    of_reading,
)
from fdi_torch.gap.localization.regressors import courses
from fdi_torch.gap.marginal_likelihood import smoothed_levels
from fdi_torch.plant.description import OUTSIDE, Sensor
from fdi_torch.plant.scales import time_scale
from fdi_torch.simulate.collocation import Collocation, Linearised
from fdi_torch.simulate.joint_collocation import JointCollocation, with_blanks
from fdi_torch.simulate.scan import product, scan_in_time

MOST_ROWS = 1000  # of a channel; more samples are taken together, for no form is as fast
SAMPLES_A_STEP = 9  # of a course in time, at least


@dataclass(frozen=True)
class NormalEquations:
    """gram (M, M) = C'C and score (M,) = C'r of a component's columns C beside the residual r of the model without
    them, under the noise of a fitter."""

    gram: Tensor
    score: Tensor


@dataclass(frozen=True)
class Discrepancy:
    """What a component's forms do to the readings, columns (S, C, M), about a trajectory."""

    columns: Tensor
    linearised: Linearised


@dataclass(frozen=True)
class Regressors:
    """Of one component along one recording: flows (M, K) m^3/s, courses in time (M', K), and, of a tank, changes of its
    level's rate (M'', K) m/s or None."""

    flows: Tensor
    in_time: Tensor
    areas: Tensor | None


@dataclass(frozen=True)
class RecordingLinearisation:
    """One recording, about levels (1, K+1, tanks). rows: its samples among all."""

    engine: Collocation
    theta: Tensor
    linearised: Linearised
    along: Forcing
    rows: slice

    @property
    def middle(self) -> Tensor:
        nodes = self.engine.experiment.nodes
        return 0.5 * (nodes[1:] + nodes[:-1])

    def seen(self, rates: Tensor) -> Tensor:
        """What changes (tanks, M, K) of the rates do to the readings, (S, C, M)."""
        gain, transition = self.linearised.gain.permute(0, 2, 3, 1), self.linearised.transition.permute(0, 2, 3, 1)
        still = rates.new_zeros(1, *rates.shape[:2])
        paths = scan_in_time(transition, rates.unsqueeze(0), still, gain)
        return (
            self.engine.look(self.linearised.levels, self.theta).along(paths, [-1] * rates.shape[1])[0].permute(2, 0, 1)
        )

    def seen_from(self, weights: Tensor) -> Tensor:
        """The transpose of `seen`: weights (S, C, M) of the readings -> of the rates, (tanks, M, K)."""
        tanks, columns = self.linearised.gain.shape[-1], weights.shape[-1]
        paths = weights.new_zeros(1, tanks, columns, self.linearised.levels.shape[1], requires_grad=True)
        readings = self.engine.look(self.linearised.levels, self.theta).along(paths, [-1] * columns)
        (by_path,) = torch.autograd.grad(readings, paths, weights.permute(1, 2, 0).unsqueeze(0))
        back, gain = self.linearised.transition.permute(0, 3, 2, 1).flip(-1), self.linearised.gain.permute(0, 3, 2, 1)
        by_level = scan_in_time(back, by_path[..., :-1].flip(-1), by_path[..., -1]).flip(-1)
        return product(gain, by_level[..., 1:])[0]


class DiscrepancyRegression:
    """The regressions of all components of a subject, beside the constants of a fit.

    periods: of waves, s. steps: in time, over all recordings.
    """

    def __init__(self, fitter: Fitter, fit: Fit, periods: Sequence[float], steps: int) -> None:
        self.fitter, self.fit, self.periods = fitter, fit, tuple(periods)
        self.engine = fitter.engine(fit.candidate, list(fit.effect_values))
        self.theta, self.levels = fit.theta.unsqueeze(0), smoothed_levels(fitter, fit)
        self.linearised = self.engine.linearise(self.theta, self.levels)
        self.pieces = self._pieces(replace(self.linearised, levels=self.levels))
        parts, samples = len(self.pieces), len(fitter.data.readings)
        self.steps = max(min(steps, samples // SAMPLES_A_STEP) // parts, 2)

    def of(self, place: str) -> Discrepancy:
        plant = self.fitter.data.plant
        sensors = [s.name for s in plant.sensors]
        if place in sensors:
            return self._of_sensor(sensors.index(place), plant.sensors[sensors.index(place)])
        return Discrepancy(self._columns(component_at(place, plant)), self.linearised)

    def _pieces(self, linearised: Linearised) -> list[RecordingLinearisation]:
        whole = self.engine
        parts = (
            whole.apart(self.theta, linearised)
            if isinstance(whole, JointCollocation)
            else [(whole, self.theta, linearised)]
        )
        found = []
        for rows, (engine, theta, own) in zip(self.fitter.data.rows, parts, strict=True):
            values = engine.network.bind(engine.space, theta.unsqueeze(-2))
            present = [p.prefix for p in engine.network.placements]
            path = own.levels[0].T.contiguous()
            along = Forcing(engine.network, present, values, path, engine.experiment)
            found.append(RecordingLinearisation(engine, theta, own, along, rows))
        return found

    def forms(self, component: DiscrepancyModel) -> list[Regressors]:
        """Of a component along each recording."""
        seen = [
            {n: x.reshape(-1).expand(len(p.middle)) for n, x in component.signals(p.along).items()} for p in self.pieces
        ]
        ends, found = SignalRanges(seen), []
        for piece, s in zip(self.pieces, seen, strict=True):
            step = piece.engine.experiment.steps
            in_time = [s[component.in_time] * c for c in self._courses(piece.middle, piece)]
            areas = torch.stack(component.areas(s, step, ends)) if component.areas else None
            found.append(Regressors(torch.stack(component.flows(s, step, ends)), torch.stack(in_time), areas))
        return found

    def _columns(self, component: DiscrepancyModel) -> Tensor:
        """(S, C, M), not whitened."""
        shared: list[Tensor] = []
        own: list[Tensor] = []
        for piece, forms in zip(self.pieces, self.forms(component), strict=True):
            changes = [self._moved(piece, component, flows) for flows in (forms.flows, forms.in_time)]
            if forms.areas is not None:
                rates = forms.areas.new_zeros(len(changes[0]), *forms.areas.shape)
                rates[self.tank(component.target)] = forms.areas
                changes.insert(0, rates)
            columns = piece.seen(torch.cat(changes, dim=1))
            shared.append(columns[..., : -len(forms.in_time)])
            own.append(columns[..., -len(forms.in_time) :])
        return _side_by_side(shared, own)

    def _moved(self, piece: RecordingLinearisation, component: DiscrepancyModel, flows: Tensor) -> Tensor:
        """Flows (M, K) from one end to the other -> how the rates change, (tanks, M, K)."""
        inflows: list[Tensor | None] = [None] * len(self.fitter.data.plant.tanks)
        for end, sign in ((component.source, -1.0), (component.target, 1.0)):
            if end != OUTSIDE:
                inflows[self.tank(end)] = sign * flows
        return piece.along.by_inflows(inflows, len(flows))

    def _courses(self, time: Tensor, piece: RecordingLinearisation) -> list[Tensor]:
        return courses(time, float(piece.engine.experiment.nodes[-1]), self.periods, self.steps)

    def tank(self, name: str) -> int:
        return [t.name for t in self.fitter.data.plant.tanks].index(name)

    def _of_sensor(self, channel: int, sensor: Sensor) -> Discrepancy:
        """About what the model makes of the sensor's tank while the others are as they were read."""
        levels = self.engine.simulate_tank(self.theta, self.levels, self.tank(sensor.tank))
        seen: list[Signals] = []
        first = 0
        for piece in self.pieces:
            nodes, times = piece.engine.experiment.nodes, piece.engine.experiment.sample_times
            own = levels[0, first : first + len(nodes), self.tank(sensor.tank)]
            seen.append({"reading": sensor.gain * interpolate(times, nodes, own) + sensor.offset, "time": times})
            first += len(nodes)
        ends = SignalRanges(seen)
        shared: list[Tensor] = []
        own_columns: list[Tensor] = []
        pace = time_scale(self.fitter.data.plant)
        for piece, s in zip(self.pieces, seen, strict=True):
            step = piece.engine.experiment.sample_intervals
            in_time = self._courses(s["time"], piece)
            for forms, into in ((of_reading(s, step, ends, pace), shared), (in_time, own_columns)):
                column = levels.new_zeros(len(step), self.fitter.data.readings.shape[1], len(forms))
                column[:, channel] = torch.stack(forms, dim=1)
                into.append(column)
        return Discrepancy(_side_by_side(shared, own_columns), self.engine.linearise(self.theta, levels))


def normal_equations(fitter: Fitter, fit: Fit, found: Discrepancy) -> NormalEquations:
    """The columns of a discrepancy beside what the parameters of a fit can do."""
    space, theta = fit.space, fit.theta
    residual, jacobian = fitter.white(found.linearised)
    scale, pull, off = fitter.priors(space, theta)
    each = max(len(residual[0]) // MOST_ROWS, 1)
    c = _together(fitter.whiten(found.columns), each).flatten(0, 1)
    r = _together(residual[0], each).flatten()
    j = _together(jacobian[0] * scale, each).flatten(0, 1)
    basis, _ = torch.linalg.qr(torch.cat([j, torch.diag(pull + 1e-9)]))
    left = torch.cat([torch.cat([c, r.unsqueeze(1)], dim=1), c.new_zeros(len(pull), c.shape[1] + 1)])
    left[len(r) :, -1] = -off
    left -= basis @ (basis.T @ left)
    both = left.T @ left
    return NormalEquations(both[:-1, :-1], both[:-1, -1])


def _side_by_side(shared: Sequence[Tensor], own: Sequence[Tensor]) -> Tensor:
    """Recordings one after the other; what each has for itself stands in columns of its own."""
    rows, widths = [], [o.shape[-1] for o in own]
    for k, (s, o) in enumerate(zip(shared, own, strict=True)):
        before, after = (o.new_zeros(*o.shape[:-1], sum(w)) for w in (widths[:k], widths[k + 1 :]))
        rows.append(torch.cat([s, before, o, after], dim=-1))
    return with_blanks(rows, dim=0)


def _together(x: Tensor, each: int) -> Tensor:
    """(S, ...) -> sums over so many samples, of unit variance again."""
    whole = len(x) // each * each
    return x[:whole].reshape(-1, each, *x.shape[1:]).sum(dim=1) / each**0.5
