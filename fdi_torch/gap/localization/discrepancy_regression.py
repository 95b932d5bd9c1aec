"""First-order influence of a component's discrepancy on the readings.

The plant, linearised about the trajectory that is predicted from earlier readings, maps each regressor to readings. The
part that constants and initial levels within their tolerances can explain is projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.gap.candidate import Fit
from fdi_torch.gap.candidate_fit import Fitter
from fdi_torch.gap.forcing import Forcing
from fdi_torch.gap.localization.component_regressors import (
    DiscrepancyModel,
    FineRegressor,
    FineRegressors,
    LocalSignals,
    Signals,
    Terms,
    discrepancy_model_at,
    reading_terms,
)
from fdi_torch.gap.localization.discrepancy_columns import Columns, Discrepancy, Position
from fdi_torch.gap.localization.predicted_levels import LevelFilter
from fdi_torch.gap.localization.recording_linearisation import RecordingLinearisation
from fdi_torch.gap.localization.regressor_families import Breakpoints, Pulses, Relays
from fdi_torch.gap.localization.regressors import harmonics, step_functions, time_functions
from fdi_torch.plant.description import OUTSIDE, Sensor
from fdi_torch.plant.scales import time_scale
from fdi_torch.simulate.joint_collocation import with_blanks
from fdi_torch.simulate.linearised import Linearised
from fdi_torch.simulate.resampling import interpolate

BATCH = 64  # regressors whose influence is computed, or whitened, together


@dataclass(frozen=True)
class Regressors:
    """Regressors of one component along one recording of K steps; of a sensor, along its K samples.

    functions (M, K): of local variables, in m^3/s, or in the sensor's unit. widths: coefficients of each regressor
    among the areas and functions. fine: kinks, jumps and relays on fine grids. in_time (T, K): functions of the time
    (K,) times `factor` (K,). frequencies (F,): of sinusoids and pulses, Hz. areas (A, K): of a tank, changes of its
    level rate, m/s; otherwise None.
    """

    functions: Tensor
    widths: tuple[int, ...]
    fine: FineRegressors
    in_time: Tensor
    time: Tensor
    factor: Tensor
    frequencies: Tensor
    areas: Tensor | None = None

    @property
    def fine_in_time(self) -> FineRegressors:
        """Steps at all times, and pulses."""
        steps = Breakpoints(self.time, self.factor, self.time, jump=True)
        return [steps, Pulses(self.time, self.factor, self.frequencies)]

    def family(self, position: Position, recording: int) -> FineRegressor | None:
        """The family of a position along this recording; None for functions of the time of another one."""
        if position.family < len(self.fine):
            return self.fine[position.family]
        of_recording, kind = divmod(position.family - len(self.fine), len(self.fine_in_time))
        return self.fine_in_time[kind] if of_recording == recording else None

    def at(self, position: Position, recording: int) -> Tensor:
        """The regressor (K,) at a position, along this recording."""
        family = self.family(position, recording)
        if family is None:
            return torch.zeros_like(self.factor)
        if position.parameters and isinstance(family, Relays | Pulses):
            return family.functions_at(self.time.new_tensor([position.parameters]))[0]
        return family.function(position.index)

    def sinusoids(self, frequency: Tensor) -> Tensor:
        """Sines and cosines at each frequency (F,), Hz, multiplied by `factor` (K,): (F, W, K)."""
        return harmonics(self.time, frequency) * self.factor


class DiscrepancyRegression:
    """Influence of the discrepancies of all components of a data set, about one fit.

    frequencies: candidates for that of the sinusoids, Hz. level_filter: predicts the levels.
    """

    def __init__(self, fitter: Fitter, fit: Fit, frequencies: Sequence[float], level_filter: LevelFilter) -> None:
        self.fitter, self.fit, self.level_filter = fitter, fit, level_filter
        self.frequencies = torch.tensor(frequencies, dtype=fit.theta.dtype)
        self.engine = fit.engine
        self.theta = fit.theta.unsqueeze(0)
        self.levels = level_filter.levels(fitter, fit)
        self.linearised = self.engine.linearise(self.theta, self.levels)
        self.pieces = self._pieces(replace(self.linearised, levels=self.levels))
        self._last: tuple[str, list[Regressors], Linearised] | None = None
        self.scale = time_scale(fitter.data.plant)
        self.steps = step_functions(len(fitter.data.readings), len(self.pieces))

    def of(self, place: str, positions: Sequence[Position] = ()) -> Discrepancy:
        """The discrepancy of all regressors of the grid, and of those at some positions between them."""
        regressors, linearised = self.at(place)
        shared = [self.influence(place, k, r.functions) for k, r in enumerate(regressors)]
        for k, r in enumerate(regressors):
            if r.areas is not None:
                shared[k] = side_by_side([self._influence_of_areas(place, k, r.areas), shared[k]])
        grid = _concatenated(shared, [self.influence(place, k, r.in_time) for k, r in enumerate(regressors)])
        frequency, columns = None, Columns((grid,))
        if len(self.frequencies):
            frequency = float(self.frequencies[0])
            columns = Columns((grid, self.sinusoids(place, self.frequencies[:1])[..., 0, :]))
        count, widths = len(columns), regressors[0].widths
        singles = [1] * (count - sum(widths))
        regressor = torch.repeat_interleave(torch.tensor([*widths, *singles]))
        choices, sinusoids = grid.new_full((count,), float(regressor[-1]) + 1.0), torch.arange(count) >= grid.shape[-1]
        # A sinusoid is one of those of all frequencies: 1 / (2 dt) over the width sqrt(2 pi) s of the posterior,
        # s = sqrt(6 / G) / (2 pi T) with a gain of G nats (Rife and Boorstyn, 1974), is 2 S if it is just worth it.
        choices[sinusoids] *= 2 * len(grid)
        discrepancy = Discrepancy(columns, linearised, regressor, choices, frequency, sinusoids)
        for position in positions:
            discrepancy = discrepancy.with_column(self.columns(place, [position])[..., 0], position)
        return discrepancy

    def columns(self, place: str, positions: Sequence[Position]) -> Tensor:
        """Influence (S, C, M) of the regressors at positions."""
        functions = [torch.stack([r.at(p, k) for p in positions]) for k, r in enumerate(self.at(place)[0])]
        return with_blanks([self.influence(place, k, f) for k, f in enumerate(functions)], dim=0)

    def sinusoids(self, place: str, frequency: Tensor) -> Tensor:
        """Influence (S, C, F, W) of harmonics of each frequency (F,), with separate amplitudes in each recording."""
        per_recording = []
        for k, regressors in enumerate(self.at(place)[0]):
            functions = regressors.sinusoids(frequency)
            per_recording.append(self.influence(place, k, functions.flatten(0, 1)).unflatten(-1, functions.shape[:2]))
        return _concatenated([c[..., :0] for c in per_recording], per_recording)

    def at(self, place: str) -> tuple[list[Regressors], Linearised]:
        """Regressors of the component at a place along each recording, and the trajectory about which they act."""
        if self._last is None or self._last[0] != place:  # those of all places would fill the memory
            plant, channel = self.fitter.data.plant, self.sensor(place)
            if channel is None:
                self._last = place, self._of_component(discrepancy_model_at(place, plant)), self.linearised
            else:
                self._last = place, *self._of_sensor(plant.sensors[channel])
        return self._last[1:]

    def families(self, place: str) -> FineRegressors:
        """The families of finer regressors at a place: of local variables, and of the time of each recording."""
        regressors = self.at(place)[0]
        return [*regressors[0].fine, *(family for r in regressors for family in r.fine_in_time)]

    def sensor(self, place: str) -> int | None:
        """The channel of a sensor; None if the place is no sensor."""
        names = [s.name for s in self.fitter.data.plant.sensors]
        return names.index(place) if place in names else None

    def influence(self, place: str, recording: int, functions: Tensor) -> Tensor:
        """Influence (S, C, M) of local functions (M, K) along one recording on its readings, not whitened."""
        piece, channel = self.pieces[recording], self.sensor(place)
        if channel is None:
            rates = (self._rate_changes(piece, place, some) for some in functions.split(BATCH))
            return side_by_side([piece.to_readings(some) for some in rates])
        columns = functions.new_zeros(functions.shape[1], self.fitter.data.readings.shape[1], len(functions))
        columns[:, channel] = functions.T
        return columns

    def _influence_of_areas(self, place: str, recording: int, areas: Tensor) -> Tensor:
        rates = areas.new_zeros(self.engine.network.order, *areas.shape)
        rates[self.tank(place)] = areas
        return self.pieces[recording].to_readings(rates)

    def _pieces(self, linearised: Linearised) -> list[RecordingLinearisation]:
        parts, pieces = self.engine.apart(self.theta, linearised), []
        for rows, (engine, theta, linearised_part) in zip(self.fitter.data.rows, parts, strict=True):
            values = engine.network.bind(engine.space, theta.unsqueeze(-2))
            present = [p.prefix for p in engine.network.placements]
            path = linearised_part.levels[0].T.contiguous()
            forcing = Forcing(engine.network, engine.network, present, values, path, engine.experiment)
            pieces.append(RecordingLinearisation(engine, theta, linearised_part, forcing, rows))
        return pieces

    def _of_component(self, component: DiscrepancyModel) -> list[Regressors]:
        signals = [
            {n: x.reshape(-1).expand(len(p.middle)) for n, x in component.signals(p.forcing).items()}
            for p in self.pieces
        ]
        regressors = []
        for piece, s in zip(self.pieces, signals, strict=True):
            at = LocalSignals(s, piece.engine.experiment.steps, self.scale, signals)
            areas = component.areas(at) if component.areas else None
            regressors.append(self._regressors(piece, component.terms(at), piece.middle, s[component.in_time], areas))
        return regressors

    def _of_sensor(self, sensor: Sensor) -> tuple[list[Regressors], Linearised]:
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
        regressors = []
        for piece, s in zip(self.pieces, signals, strict=True):
            at = LocalSignals(s, piece.engine.experiment.sample_intervals, self.scale, signals)
            regressors.append(self._regressors(piece, reading_terms(at), s["time"], torch.ones_like(s["time"])))
        return regressors, self.engine.linearise(self.theta, levels)

    def _regressors(
        self,
        piece: RecordingLinearisation,
        terms: Sequence[Terms],
        time: Tensor,
        factor: Tensor,
        areas: Terms | None = None,
    ) -> Regressors:
        functions, widths = _stacked([f for term in terms for f in term.grid])
        of_areas, widths_of_areas = _stacked(areas.grid) if areas else (None, ())
        in_time = factor * torch.stack(time_functions(time, float(piece.engine.experiment.nodes[-1]), self.steps))
        fine = [family for term in terms for family in term.fine]
        return Regressors(functions, widths_of_areas + widths, fine, in_time, time, factor, self.frequencies, of_areas)

    def _rate_changes(self, piece: RecordingLinearisation, place: str, flows: Tensor) -> Tensor:
        """Map flows (M, K) at a place to changes of the rates (n, M, K)."""
        inflows: list[Tensor | None] = [None] * len(self.fitter.data.plant.tanks)
        for tank, sign in self.ends(place):
            inflows[tank] = sign * flows
        return piece.forcing.by_inflows(inflows, len(flows))

    def ends(self, place: str) -> list[tuple[int, float]]:
        """The tanks whose balances the discrepancy flow at a place changes, each with the sign."""
        component = discrepancy_model_at(place, self.fitter.data.plant)
        ends = (component.source, -1.0), (component.target, 1.0)
        return [(self.tank(tank), sign) for tank, sign in ends if tank != OUTSIDE]

    def tank(self, name: str) -> int:
        return [t.name for t in self.fitter.data.plant.tanks].index(name)


def _stacked(regressors: Sequence[Tensor]) -> tuple[Tensor, tuple[int, ...]]:
    """Regressors (K,) or (N, K) as one tensor (M, K), and the number of coefficients of each."""
    each = [torch.atleast_2d(r) for r in regressors]
    return torch.cat(each), tuple(map(len, each))


def _concatenated(shared: Sequence[Tensor], per_recording: Sequence[Tensor]) -> Tensor:
    """Stack the recordings; columns of `own` belong to one recording each."""
    rows, widths = [], [o.shape[-1] for o in per_recording]
    for k, (s, o) in enumerate(zip(shared, per_recording, strict=True)):
        before, after = (o.new_zeros(*o.shape[:-1], sum(w)) for w in (widths[:k], widths[k + 1 :]))
        rows.append(side_by_side([s, before, o, after]))
    return with_blanks(rows, dim=0)


def side_by_side(columns: Sequence[Tensor]) -> Tensor:
    """Columns (S, ..., .) in one tensor (S, ..., M), with time last in memory."""
    return torch.cat([c.movedim(0, -1) for c in columns], dim=-2).movedim(-1, 0)
