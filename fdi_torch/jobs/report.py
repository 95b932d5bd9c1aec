"""The report job, one HTML page for one or more logs and its pictures as files, and the comparison of runs that `fdi
compare` prints and `fdi_torch.compare` returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fdi_torch import logbook
from fdi_torch.config.logged_config import logged_plant
from fdi_torch.disk import write_text
from fdi_torch.logbook import Comparison, Run, read_run
from fdi_torch.plant.description import PlantDescription
from fdi_torch.progress import Tell, rounded, silent
from fdi_torch.report.comparison import DIFFERENCE, comparison_section, in_words, result_table
from fdi_torch.report.comparison_headline import comparison_headline, setting_table
from fdi_torch.report.html import Markup
from fdi_torch.report.material import Material, gather
from fdi_torch.report.page import RunReport, page, report_of, write_pictures
from fdi_torch.report.section import Picture, Section
from fdi_torch.report.style import notebook_svg
from fdi_torch.report.verdict import headline
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units


@dataclass(frozen=True, repr=False)
class Report(Shown):
    """page: the HTML file. pictures: PNG and SVG files. headlines: one per log. notes: what could not be shown."""

    page: Path
    pictures: tuple[Path, ...]
    headlines: dict[str, str]
    notes: tuple[str, ...] = ()

    @property
    def headline(self) -> str:
        return f"page: {self.page}"

    def table(self) -> Table:
        """One row per log."""
        return Table(("log", "says"), list(self.headlines.items()))


def report(
    logs: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    pictures: bool = False,
    tell: Tell = silent,
) -> Report:
    """Write one page for the logs; several logs are also compared.

    out: the page or its folder; by default next to the first log. pictures: also write each picture as PNG and SVG.
    Raises ValueError without logs, if one cannot be read, or if the page's name does not end in .html.
    """
    paths = [Path(name) for name in ([logs] if isinstance(logs, str | Path) else logs)]
    if not paths:
        raise ValueError("report: expected at least one log, got none; name some")
    target = page_path(paths, None if out is None else str(out))
    reports: list[RunReport] = []
    notes: list[str] = []
    for k, path in enumerate(paths):
        reports.append(report_of_log(path, notes))
        rounded(tell)((k + 1) / (len(paths) + 1), path.name)
    write_text(target, page_of(reports))
    written: list[Path] = []
    for k, each in enumerate(reports if pictures else ()):
        several = f"{k + 1}_" if len(reports) > 1 else ""
        written += write_pictures(each.pictures, target.with_suffix("") / several)
    tell(1.0, "done")
    headlines = {str(each.material.run.path): headline(each.material) for each in reports}
    return Report(target, tuple(written), headlines, tuple(notes))


def report_of_log(path: Path, notes: list[str]) -> RunReport:
    """The report of one log; what could not be shown is added to `notes`. Raises LogError if it cannot be read."""
    log = read_run(path, salvage=True)
    return report_of(gather(log, plant_of(log, notes)))


def page_of(reports: Sequence[RunReport], above: Sequence[Markup] = ()) -> str:
    """The page of the runs; several are compared first. above: elements at its top."""
    return page(reports, [comparison_of(reports)] if len(reports) > 1 else [], above)


def comparison_of(reports: Sequence[RunReport]) -> Section:
    """Comparison of all runs, or the reason why they cannot be compared."""
    runs = [report.material for report in reports]
    try:
        return comparison_section(logbook.compare([run.run.path for run in runs]), runs)
    except (ValueError, KeyError, TypeError, IndexError, OSError) as error:
        return Section("Comparison", [f"These logs cannot be compared: {error}"])


def page_path(logs: list[Path], out: str | None) -> Path:
    """Path of the page; it never overwrites a log."""
    name = logs[0].name.removesuffix(".partial").removesuffix(".mcap") + ("_and_more" if len(logs) > 1 else "")
    if out is None:
        return logs[0].with_name(f"{name}.html")
    path = Path(out)
    if path.is_dir() or not path.suffix:
        return path / f"{name}.html"
    if path.suffix not in (".html", ".htm"):
        raise ValueError(f"expected a page that ends in .html, or a folder, got {out}; rename it")
    return path


def plant_of(log: Run, notes: list[str]) -> PlantDescription | None:
    """The logged plant; None if it cannot be read, with a note, and for a blind benchmark, which has many rigs."""
    if log.about("run").get("kind") == "challenge":
        return None
    try:
        return logged_plant(log)
    except (ValueError, OSError) as error:
        notes.append(f"no drawing of the rig: {error}")
        return None


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
        hypothesis that all runs estimate one value; `agree`: whether it holds at 95 %, None if no error is known or if
        runs read the same recording; the largest difference of two runs in the smaller of their standard errors.
        """
        errors = [(label, f"{label} std error") for label in self.comparison.labels]
        rows = []
        for each in self.comparison.results:
            numbers = [number for pair in zip(each.values, each.std, strict=True) for number in pair]
            shown = in_display_unit(each.name, each.unit, *numbers)
            rows.append((each.name, *shown, each.p_value, each.agree, each.apart))
        return Table(("parameter", "unit", *sum(errors, ()), "p", "agree", DIFFERENCE), rows)

    @property
    def verdicts(self) -> dict[str, str]:
        """The verdict of each run in one sentence."""
        return {label: headline(run) for label, run in zip(self.comparison.labels, self.runs, strict=True)}

    def settings(self) -> Table:
        """One row per setting that differs, in words; what parts that not every run has differ in is left out."""
        return setting_table(self.comparison, self.runs)

    @in_its_units
    def tables(self) -> list[Table]:
        """The settings that differ, unless the runs are of different kinds, whose keys differ; and the estimates."""
        of_one_kind = len({run.kind for run in self.runs}) == 1
        tables = [*([self.settings()] if of_one_kind else []), result_table(self.comparison)]
        return [table for table in tables if len(table)]

    @in_its_units
    def brief(self) -> Table:
        """The estimates with their errors, as `fdi compare` prints them; without any, the settings."""
        return result_table(self.comparison) if self.comparison.results else self.settings()

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
        sentences = (*comparison_headline(comparison, runs), *in_words(comparison, runs))
        return ComparisonResult(comparison, runs, sentences)
