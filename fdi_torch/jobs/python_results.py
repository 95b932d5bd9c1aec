"""Results of the Python functions that display themselves: as text, as tables and pictures in notebooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from fdi_torch.amounts import end_words
from fdi_torch.effects import build_network
from fdi_torch.estimate.misfit import Misfit, misfit_of
from fdi_torch.estimate.uncertainty import parameters_at_bounds
from fdi_torch.gap.answer import Answer, adopted
from fdi_torch.gap.constant_remarks import OFF_TOLERANCES
from fdi_torch.gap.free_runs.between_runs import between_run_spread
from fdi_torch.gap.free_runs.prediction import LeftOutRun, Prediction
from fdi_torch.gap.free_runs.refit import Refit, narrowed
from fdi_torch.gap.verdict_words import verdict_sentence
from fdi_torch.logbook import read_run
from fdi_torch.monitor.events import Event
from fdi_torch.names import counted
from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.description import PlantDescription, Sensor
from fdi_torch.quantities import display_unit, quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import doubts_about
from fdi_torch.report.fit_figure import fit_figure
from fdi_torch.report.gap_tables import cause_table, explanation_table
from fdi_torch.report.material import gather
from fdi_torch.report.sections.gap import posterior_bars
from fdi_torch.report.sections.monitor import statistic_section
from fdi_torch.report.style import notebook_svg
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units


@dataclass(frozen=True, repr=False)
class GapResult(Shown):
    """answer: verdict, causes, explanations and closure. log: the MCAP log, for `report` and `fdi replay`."""

    answer: Answer
    plant: PlantDescription
    log: Path

    @property
    @in_its_units
    def headline(self) -> str:
        return verdict_sentence(self.answer.to_dict())

    @in_its_units
    def table(self) -> Table:
        """One row per parameter of each cause, in its unit for display; without a cause, the explanations and their
        probabilities.
        """
        causes = cause_table(self.answer.to_dict())
        return causes if len(causes) else self.explanations()

    @in_its_units
    def explanations(self) -> Table:
        """All explanations with their posterior probabilities, likeliest first."""
        return explanation_table(self.answer.to_dict())

    def picture(self) -> str:
        """The probabilities of the explanations, as SVG."""
        bars = posterior_bars(self.answer.to_dict())
        return notebook_svg(bars[0][0].figure, self.log.stem, self.headline) if bars else ""

    def adopted(self, constants: bool = False) -> PlantDescription:
        """The plant with the causes added as effects. constants: also use the constants fitted together with them."""
        return adopted(self.plant, self.answer, constants)

    def narrowed(self) -> PlantDescription:
        """The plant with the causes and the fitted constants, their standard errors as tolerances where smaller."""
        return narrowed(self.adopted(constants=True), {n: float(c["std"]) for n, c in self.answer.constants.items()})


@dataclass(frozen=True, repr=False)
class MonitorResult(Shown):
    """events: in order of time. lasted: duration of the recording, s. spent: computing time, s."""

    events: tuple[Event, ...]
    lasted: float
    spent: float
    log: Path

    @property
    def headline(self) -> str:
        alarms = sum(event.kind == "alarm" for event in self.events)
        count = counted(alarms, "alarm") if alarms else "no alarm"
        isolated = [event for event in self.events if event.kind in ("isolated", "revised")]
        return f"{count} in {self.lasted:g} s" + (f"; {isolated[-1].headline}" if isolated else "")

    @in_its_units
    def table(self) -> Table:
        """One row per event; sizes in the units of the column `units`."""
        names = ("time", "kind", "alarm", "text", "headline", "faults", "onset", "onset_std")
        rows = []
        for event in self.events:
            sizes = zip(event.faults, event.units, event.sizes, event.stds, strict=True)
            amounts = [*zip(*(in_display_unit(*size) for size in sizes), strict=True)] or [()] * 3
            rows.append((*(getattr(event, name) for name in names), *amounts))
        return Table((*names, "units", "sizes", "stds"), rows)

    @in_its_units
    def picture(self) -> str:
        """The test statistic with its threshold and the alarms, as SVG."""
        section = statistic_section(gather(read_run(self.log)))
        return notebook_svg(section.pictures[0].figure, self.log.stem, self.headline) if section else ""

    def brief(self) -> Table:
        return Table(("time, s", "event", "text"), [(e.time, e.kind, e.text) for e in self.events])


@dataclass(frozen=True, repr=False)
class FreeRun(Shown):
    """Free run of a plant along a recording, from initial levels estimated from the first samples."""

    plant: PlantDescription
    recording: Recording
    prediction: Prediction

    @property
    @in_its_units
    def headline(self) -> str:
        return "; ".join([self.title, *self.doubts])

    @property
    @in_its_units
    def doubts(self) -> tuple[str, ...]:
        """What limits the trust in the recording, one sentence each."""
        return doubts_about([self.recording], self.plant)

    @property
    def title(self) -> str:
        """The headline without its doubts."""
        return self.misfit.headline(f"free run of {self.plant.name} along {self.recording.source}")

    @property
    def misfit(self) -> Misfit:
        return misfit_of(self.prediction.rmse, [self.recording], self.plant)

    @in_its_units
    def table(self) -> Table:
        """One row per sensor: root mean square error, in its unit for display."""
        rows = [(s.name, *in_display_unit(s.column, s.unit, self.prediction.rmse[s.name])) for s in self.plant.sensors]
        return Table(("sensor", "unit", "RMSE"), rows)

    @in_its_units
    def picture(self) -> str:
        """Measured and predicted readings, as SVG."""
        predictions = {self.plant.name: self.prediction.readings}
        figure = fit_figure(self.recording, predictions, self.title, self.plant, self.plant.outputs())
        return notebook_svg(figure, "free-run", self.title)

    def to_xarray(self) -> Any:
        """An xarray.Dataset (extra `xarray`) of measured, predicted and residual over time and sensor, SI."""
        return self.recording.selected((), self.plant.outputs()).compared(self.prediction.readings)


@dataclass(frozen=True, repr=False)
class RefitResult(Shown):
    """fit: errors, values and standard errors, SI. misfit: of all recordings. given: the plant before the fit. doubts:
    what limits the trust in the recordings and the hold-outs, one sentence each. trials: errors (SI) of free runs along
    the hold-outs, of the plant as given and as refitted."""

    fit: Refit
    misfit: Misfit
    given: PlantDescription
    doubts: tuple[str, ...] = ()
    trials: tuple[LeftOutRun, ...] = ()

    @property
    def plant(self) -> PlantDescription:
        """The plant with fitted constants and effects."""
        return self.fit.plant

    @property
    @in_its_units
    def headline(self) -> str:
        rmse = self.fit.rmse
        errors = ", ".join(f"{s.name} {quantity_text(rmse[s.name], s.unit, name=s.column)}" for s in self.plant.sensors)
        return self.misfit.headline(f"refit of {self.plant.name}: root mean square error {errors}")

    @in_its_units
    def table(self) -> Table:
        """One row per value that all recordings share, in its unit for display, beside the one in the plant file."""
        constants = build_network(self.given).constants
        rows = [
            (name, *in_display_unit(name, constants[name].unit, constants[name].nominal, *pair))
            for name, pair in self.fit.fitted.items()
        ]
        return Table(("parameter", "unit", "plant file", "fitted", "std error"), rows, "fitted to all recordings")

    @in_its_units
    def errors(self) -> Table:
        """One row per sensor: root mean square error with the constants fitted and, if there are any, the effects."""
        fits = {"constants fitted": self.fit.before, "constants and effects fitted": self.fit.rmse}
        fits = fits if self.plant.effects else {"constants fitted": self.fit.rmse}
        columns = zip(*(shown_errors(self.plant, rmse) for rmse in fits.values()), strict=True)
        rows = [(s.name, *row, sensor_unit(s)) for s, row in zip(self.plant.sensors, columns, strict=True)]
        return Table(("sensor", *fits, "unit"), rows, "root mean square error", digits=4)

    def remarks(self) -> list[str]:
        """Values that are far from those of the plant file, or at an end of their range."""
        constants = build_network(self.given).constants
        space = ParameterSpace([constants[name] for name in self.fit.fitted])
        values = torch.tensor([value for value, _ in self.fit.fitted.values()], dtype=torch.float64)
        far = {p.name: abs(value - p.nominal) / p.std for p, value in zip(space, values.tolist(), strict=True)}
        remarks = [
            f"{name} lies {tolerances:.2g} tolerances from its value in the plant file"
            for name, tolerances in far.items()
            if tolerances > OFF_TOLERANCES
        ]
        return [*remarks, *(end_words(*each) for each in parameters_at_bounds(space, values).items())]

    @in_its_units
    def by_recording(self) -> Table:
        """Values that differ by recording, and their between-run variation."""
        constants, rows = build_network(self.plant).constants, list[tuple[Any, ...]]()
        for name in dict.fromkeys(own.name for own in self.fit.own):
            unit, scale = display_unit(constants[name].unit, name)
            each = [own for own in self.fit.own if own.name == name]
            rows += [(name, Path(o.source).name, o.start, scale * o.value, scale * o.std, unit) for o in each]
            if variation := between_run_spread(each, constants[name].std):
                std, low, high = (f"{scale * x:.2g}" for x in (variation.std, variation.low, variation.high))
                mean, of = f"{scale * variation.mean:.4g}", f"mean and between-run std of {variation.count}"
                rows.append((name, of, None, mean, f"{std} (95 %: {low} to {high})", unit))
        header = ("parameter", "recording", "from, s", "value", "std error", "unit")
        return Table(header, rows, "values of each recording")

    def narrowed(self) -> PlantDescription:
        """The plant with the standard errors of the fit as tolerances where these are smaller."""
        return self.fit.narrowed()


def sensor_unit(sensor: Sensor) -> str:
    """The unit for display of a sensor's readings."""
    return display_unit(sensor.unit, sensor.column)[0] or "share"


def shown_errors(plant: PlantDescription, rmse: Mapping[str, float]) -> list[float | None]:
    """Errors of the plant's sensors, SI by sensor, in their units for display; None for a sensor without one."""
    scales = {s.name: display_unit(s.unit, s.column)[1] for s in plant.sensors}
    return [scale * rmse[name] if name in rmse else None for name, scale in scales.items()]


def error_table(trials: Sequence[LeftOutRun], plant: PlantDescription, refitted: str) -> Table:
    """One row per free run: errors of the plant file, and of the refitted plant. refitted: to what, in words."""
    errors = [[*shown_errors(plant, t.as_is), *shown_errors(plant, t.refitted)] for t in trials]
    rows = [(Path(t.source).name, t.start, t.stop, *each) for t, each in zip(trials, errors, strict=True)]
    names = (f"{s.name} {of}, {sensor_unit(s)}" for of in ("as is", "refitted") for s in plant.sensors)
    title = f"root mean square error of free runs; {refitted}"
    return Table(("run", "from, s", "to, s", *names), rows, title, digits=4)
