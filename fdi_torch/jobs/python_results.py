"""Results of the Python functions that display themselves: as text, as tables and pictures in notebooks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fdi_torch.amounts import effect_words
from fdi_torch.effects import build_network
from fdi_torch.estimate.misfit import Misfit, misfit_of
from fdi_torch.gap.answer import Answer, adopted
from fdi_torch.gap.free_runs.prediction import LeftOutRun, Prediction
from fdi_torch.gap.free_runs.refit import Refit, narrowed
from fdi_torch.gap.verdict_words import MEAN_FLOW, explanation_words, verdict_sentence
from fdi_torch.logbook import read_run
from fdi_torch.monitor.events import Event
from fdi_torch.names import counted
from fdi_torch.parameters import ParameterName
from fdi_torch.plant.description import PlantDescription
from fdi_torch.quantities import quantity_text
from fdi_torch.recording import Recording
from fdi_torch.recordings.check import doubts_about
from fdi_torch.report.fit_figure import fit_figure
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
        rows = []
        for cause in self.answer.causes:
            for name, a in cause.parameters.items():
                full = str(ParameterName(cause.location, cause.effect, name))
                unit, value, std = in_display_unit(full, a.unit, a.value, a.std)
                rows.append((effect_words(cause.effect, cause.location), name, value, std, unit))
            if cause.flow is not None:
                unit, flow = in_display_unit("", "m^3/s", cause.flow)
                rows.append((effect_words(cause.effect, cause.location), MEAN_FLOW, flow, math.nan, unit))
        return (
            Table.of_rows(("cause", "parameter", "value", "std error", "unit"), rows) if rows else self.explanations()
        )

    def explanations(self) -> Table:
        """All explanations with their posterior probabilities, likeliest first."""
        posterior = self.answer.to_dict()["posterior"]
        rows = [(explanation_words(e["causes"]), e["probability"]) for e in posterior]
        return Table.of_rows(("explanation", "probability"), rows)

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
        columns = {name: [getattr(event, name) for event in self.events] for name in names}
        sizes = [
            [in_display_unit(*s) for s in zip(e.faults, e.units, e.sizes, e.stds, strict=True)] for e in self.events
        ]
        amounts = {
            name: [tuple(s[k] for s in each) for each in sizes] for k, name in enumerate(("units", "sizes", "stds"))
        }
        return Table(columns | amounts)

    @in_its_units
    def picture(self) -> str:
        """The test statistic with its threshold and the alarms, as SVG."""
        section = statistic_section(gather(read_run(self.log)))
        return notebook_svg(section.pictures[0].figure, self.log.stem, self.headline) if section else ""

    def brief(self) -> Table:
        return Table.of_rows(("time, s", "event", "text"), [(e.time, e.kind, e.text) for e in self.events])


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
        return Table.of_rows(("sensor", "unit", "RMSE"), rows)

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
    """plant: the plant with fitted constants and effects. fit: errors, values and standard errors, SI.
    misfit: of all recordings. doubts: what limits the trust in these and in the hold-outs, one sentence each. trials:
    errors (SI) of free runs along the hold-outs, of the plant as given and as refitted."""

    fit: Refit
    misfit: Misfit
    doubts: tuple[str, ...] = ()
    trials: tuple[LeftOutRun, ...] = ()

    @property
    def plant(self) -> PlantDescription:
        return self.fit.plant

    @property
    @in_its_units
    def headline(self) -> str:
        rmse = self.fit.rmse
        errors = ", ".join(f"{s.name} {quantity_text(rmse[s.name], s.unit, name=s.column)}" for s in self.plant.sensors)
        return self.misfit.headline(f"refit of {self.plant.name}: root mean square error {errors}")

    @in_its_units
    def table(self) -> Table:
        """One row per value that all recordings share, in its unit for display."""
        constants = build_network(self.plant).constants
        rows = [(n, *in_display_unit(n, constants[n].unit, *pair)) for n, pair in self.fit.fitted.items()]
        return Table.of_rows(("parameter", "unit", "value", "std error"), rows)

    def narrowed(self) -> PlantDescription:
        """The plant with the standard errors of the fit as tolerances where these are smaller."""
        return self.fit.narrowed()
