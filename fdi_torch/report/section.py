"""A section of the page: a title with text, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from fdi_torch.report.chart import TIME, Chart, Line, chart_json, draw
from fdi_torch.report.html import Markup, clean, escape, join, tag
from fdi_torch.report.material import Material
from fdi_torch.report.numbers import axis, shown_unit
from fdi_torch.report.style import inline_svg

REM_PER_INCH = 7.6  # width of a wide picture; its text then has the size of the page's text
LEAST_REM_PER_INCH = 5.6  # on a small screen, where a picture that is wider still scrolls
WIDE = 36.0  # rem; a picture that is narrower leaves room for another card


@dataclass(frozen=True)
class Picture:
    """name: of its file, without suffix. caption: description, also for screen readers. wide: uses a whole row.
    chart: its signals, for the interactive chart; see `signals`.
    """

    name: str
    figure: Figure
    caption: str = ""
    wide: bool = False
    chart: Chart | None = None


Column = tuple[Picture, ...]  # pictures below each other, such as a sensor's readings and residuals


@dataclass(frozen=True)
class Section:
    """blocks: markup, text (a paragraph), or a list of pictures and columns of pictures in a grid.

    lead: belongs to the result, which stands at the top of the page beside the rig.
    """

    title: str
    blocks: Sequence[Markup | str | Sequence[Picture | Column]]
    lead: bool = False

    @property
    def pictures(self) -> list[Picture]:
        entries = [entry for block in self.blocks if not isinstance(block, str) for entry in block]
        return [p for entry in entries for p in ((entry,) if isinstance(entry, Picture) else entry)]


Maker = Callable[[Material], "Section | None"]


def signals(name: str, chart: Chart, caption: str = "") -> Picture:
    """A picture of signals that is an interactive chart where scripts run."""
    return Picture(name, draw(chart), caption, chart=chart)


def channel_signals(
    name: str, title: str, label: str, si_unit: str, lines: Sequence[Line], channel: str = "", **about: Any
) -> Picture:
    """Signals of one quantity over time in its unit for display. lines: SI. channel: chooses the unit.

    about: further fields of the `Chart`.
    """
    unit, scale = shown_unit(si_unit, channel)
    lines = [line._replace(y=scale * line.y) for line in lines]
    return signals(name, Chart(title, y_label=axis(label, unit), lines=lines, **({"x_label": TIME} | about)))


def section_html(section: Section, prefix: str, own_id: str) -> Markup:
    """The section as HTML. prefix: makes picture ids unique on the page. own_id: that of the section."""
    blocks = []
    for block in section.blocks:
        if isinstance(block, str):
            blocks.append(block if isinstance(block, Markup) else tag("p", block))
            continue
        entries = []
        for entry in block:
            figures = [_figure(each, prefix) for each in ([entry] if isinstance(entry, Picture) else entry)]
            entries += figures if isinstance(entry, Picture) else [tag("div", *figures, class_="column")]
        blocks.append(tag("div", *entries, class_="grid"))
    return tag("section", tag("h3", section.title), join(blocks), id=own_id)


def _figure(picture: Picture, prefix: str) -> Markup:
    described = escape(clean(picture.caption or picture.name))
    svg = Markup(inline_svg(picture.figure, f"{prefix}{picture.name}", described))
    caption = [tag("figcaption", picture.caption)] if picture.caption else []
    if picture.chart is not None:
        clock = f"{prefix}{picture.chart.clock or picture.name}"
        return tag("figure", svg, *caption, data_chart=chart_json(picture.chart), data_clock=clock)
    if not picture.wide:
        return tag("figure", svg, *caption)
    usual, least = (rem * picture.figure.get_figwidth() for rem in (REM_PER_INCH, LEAST_REM_PER_INCH))
    kind = "wide" if usual > WIDE else "wide small"
    return tag("figure", svg, *caption, class_=kind, style=f"max-width: {usual:.1f}rem; --least: {least:.1f}rem")
