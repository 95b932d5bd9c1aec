"""The comparison of runs that `fdi compare` prints and `fdi_torch.compare` returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fdi_torch import logbook
from fdi_torch.jobs.report import plant_of
from fdi_torch.logbook import Comparison, read_run
from fdi_torch.report.comparison import comparison_section, in_words, result_table
from fdi_torch.report.comparison_headline import comparison_headline, setting_differences
from fdi_torch.report.material import Material, gather
from fdi_torch.report.section import Picture
from fdi_torch.report.style import notebook_svg
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units


@dataclass(frozen=True, repr=False)
class ComparisonResult(Shown):
    """Runs beside each other, in the units of the first run's plant.

    comparison: differences and estimates in SI. runs: contents of the logs, in the order of `comparison.labels`.
    sentences: the better run, unreliable runs, what differs in the inputs, and whether the estimates agree.
    """

    comparison: Comparison
    runs: tuple[Material, ...]
    sentences: tuple[str, ...]

    @property
    def headline(self) -> str:
        return " ".join(self.sentences)

    @in_its_units
    def table(self) -> Table:
        """One row per estimated parameter: value and standard error in each run, in its unit for display; `p`: of the
        hypothesis that all runs estimate one value; `agree`: whether it holds at 95 %, None if no error is known.
        """
        errors = [(label, f"{label} std error") for label in self.comparison.labels]
        rows = []
        for each in self.comparison.results:
            numbers = [number for pair in zip(each.values, each.std, strict=True) for number in pair]
            rows.append((each.name, *in_display_unit(each.name, each.unit, *numbers), each.p_value, each.agree))
        return Table.of_rows(("parameter", "unit", *sum(errors, ()), "p", "agree"), rows)

    def settings(self) -> Table:
        """One row per setting that differs, in words; what parts that not every run has differ in is left out."""
        rows = [(key, *texts) for key, texts in setting_differences(self.comparison, self.runs)[0].items()]
        return Table.of_rows(("key", *self.comparison.labels), rows)

    @in_its_units
    def brief(self) -> Table:
        """The estimates with their errors, as `fdi compare` prints them; without any, the settings."""
        return Table.of_rows(*result_table(self.comparison)) if self.comparison.results else self.settings()

    @property
    def pictures(self) -> list[Picture]:
        """Convergence and residuals of all runs."""
        return comparison_section(self.comparison, self.runs).pictures

    def picture(self) -> str:
        """The same as SVG."""
        return "".join(notebook_svg(each.figure, each.name, self.headline) for each in self.pictures)


def compare(logs: Sequence[str | Path]) -> ComparisonResult:
    """Compare runs by their logs, as `fdi compare` does: which explains the recording best, and what differs.

    logs: two or more, such as `result.log`. Raises LogError for an unreadable log, ValueError for fewer than two.
    """
    comparison = logbook.compare(logs)
    runs = tuple(gather(log, plant_of(log, [])) for log in map(read_run, logs))
    with runs[0].in_its_units():
        sentences = (*comparison_headline(comparison, runs), *in_words(comparison))
        return ComparisonResult(comparison, runs, sentences)
