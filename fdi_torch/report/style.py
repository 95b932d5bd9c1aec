"""Style of all figures: colours that colour-blind readers can distinguish, units on every axis, labels above the data,
SVG whose colours follow the page's light or dark theme, and the panels that several sections share.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import ceil, floor, log10
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from fdi_torch.amounts import RAISED
from fdi_torch.disk import replacing
from fdi_torch.report.html import escape, short

# Readings are grey, models blue, deviations orange, a second model or the truth green
# (after Okabe & Ito 2008, darkened until text in them has a contrast of 4.5 on white).
INK, SOFT, FAINT = "#1f2933", "#67727e", "#d3d9e0"
MODEL, MARK, OTHER = "#0b6cab", "#b84a00", "#0b7558"
PAPER = "#fefefe"

# Colour -> name of its CSS variable.
VARIABLES = {INK: "ink", SOFT: "soft", FAINT: "faint", MODEL: "model", MARK: "mark", OTHER: "other", PAPER: "paper"}
_SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "fdi_torch",
    "text.parse_math": False,
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": SOFT,
    "axes.labelcolor": SOFT,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "legend.frameon": False,
    "legend.labelcolor": "linecolor",
    "legend.handlelength": 1.0,
    "legend.handletextpad": 0.4,
    "legend.columnspacing": 0.9,
    "legend.borderaxespad": 0.0,
    "legend.fontsize": 9.0,
    "text.color": INK,
    "lines.linewidth": 1.5,
    "figure.facecolor": PAPER,
    "axes.facecolor": "none",
    "savefig.facecolor": PAPER,
}
WIDTH, HEIGHT = 3.2, 2.3  # inches; letters of 9 points then have 11 pixels in the narrowest card
MOST_TITLE, LETTERS_AN_INCH = 400, 10


@contextmanager
def styled() -> Iterator[None]:
    """Context in which figures are made and saved in this style, without warnings about missing glyphs."""
    with matplotlib.rc_context(_SETTINGS), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*missing from.*font")
        yield


def panel(title: str, x_label: str, y_label: str, width: float = WIDTH, height: float = HEIGHT) -> tuple[Figure, Axes]:
    """A small figure with one pair of axes, sized for phones and grids. width, height in inches."""
    with styled():
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        set_panel_title(axes, title)
        axes.set_xlabel(fill(x_label, int(LETTERS_AN_INCH * width)))
        axes.set_ylabel(fill(y_label, max(int(1.1 * LETTERS_AN_INCH * height), 12)))
    return figure, axes


def logarithmic(axes: Axes, linear_width: float = 0.0) -> None:
    """Make the vertical axis logarithmic, with plain numbers; with a `linear_width` it is linear below that (asinh)."""
    if linear_width:
        axes.set_yscale("asinh", linear_width=linear_width)
        high = axes.dataLim.y1
        axes.set_yticks([0.0, *(10.0**k for k in range(ceil(log10(linear_width)), floor(log10(high)) + 1))])
        axes.yaxis.set_major_formatter(lambda value, place: f"{value:g}")
        axes.set_ylim(0.0, 1.3 * high)
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, place: power_text(value))
    low, high = axes.get_ylim()
    few = high < 30.0 * low  # so few decades that intermediate ticks need labels too
    axes.yaxis.set_minor_formatter((lambda value, place: power_text(value)) if few else NullFormatter())


def power_text(value: float) -> str:
    """'0.001', but '10⁻⁵' and '2·10⁻⁵' below it."""
    if not 0.0 < value < 1e-3:
        return f"{value:g}"
    digits, exponent = f"{value:.1e}".split("e")
    power = f"10{str(int(exponent)).translate(RAISED)}"
    return power if float(digits) == 1.0 else f"{float(digits):g}·{power}"


def label_lines(axes: Axes) -> None:
    """Label the lines above the plot in their colours, so that no box hides data; a long title is above the labels."""
    title, names = axes.get_title("left"), axes.get_legend_handles_labels()[1]
    widths = [len(name) + 4 for name in names]
    row = int(1.4 * row_letters(axes))  # the letters of labels are smaller than those of titles
    columns = len(names) if sum(widths) <= row else max(1, row // max(widths))
    with styled():
        if "\n" in title or columns < len(names) or len(title) + sum(widths) > row_letters(axes):
            axes.set_title(title, pad=5.0 + 13.5 * ceil(len(names) / columns))
        axes.legend(loc="lower right", bbox_to_anchor=(1.02, 0.97), ncols=columns)


def set_panel_title(axes: Axes, title: str) -> None:
    """Set the title of a panel, broken into lines that fit its width."""
    axes.set_title(fill(title, row_letters(axes)))


def row_letters(axes: Axes) -> int:
    """Letters of a panel's title that fit one row."""
    place, figure = axes.get_subplotspec(), axes.get_figure(root=True)
    columns = place.get_gridspec().ncols if place else 1
    return int(LETTERS_AN_INCH * (figure.get_figwidth() / columns - 0.7)) if figure else MOST_TITLE


def set_title(figure: Figure, title: str) -> None:
    """Set the title over all panels, broken into lines that fit the figure's width."""
    together = short(title, MOST_TITLE).replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")
    figure.suptitle(fill(together, int(LETTERS_AN_INCH * figure.get_figwidth())))


def save(figure: Figure, path: Path) -> Path:
    """Write the picture as PNG or SVG, by the path's suffix; equal figures give equal files. Raises ValueError."""
    if path.suffix not in (".png", ".svg"):
        raise ValueError(f"expected a picture that ends in .png or .svg, got {path}; rename it")
    metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    with styled(), replacing(path) as new:
        figure.savefig(new, dpi=160, metadata=metadata)
    return path


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """The figure as an element of our pages: colours are the page's variables, ids are prefixed with `name`."""
    svg = _svg(figure, name, description)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, f"var(--{variable})")
    return svg


def notebook_svg(figure: Figure, name: str, description: str) -> str:
    """The figure as an HTML element for notebooks, on a background of its own, no larger than its natural size, in
    which letters of 9 points have 12 pixels.
    """
    width = f"{96 * figure.get_figwidth():g}px"
    style = f"max-width: {width}; background: {PAPER}; color: {INK}"
    svg = _svg(figure, re.sub(r"\W+", "-", name), escape(description))
    return f'<div style="{style}">{svg}</div>'


def _svg(figure: Figure, name: str, description: str) -> str:
    text = io.StringIO()
    with styled():
        figure.savefig(text, format="svg", metadata={"Date": None}, transparent=True)
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', rf'\1 role="img" aria-label="{description}"', svg, count=1)
    svg = re.sub(r"(font(?:-family)?:[^;\"]*?)'DejaVu Sans'(, [^;\"]*)?", r"\1system-ui, sans-serif", svg)
    return _own_ids(svg, name)


def _own_ids(svg: str, name: str) -> str:
    """Prefix the ids that are referenced with `name`, and remove the others."""
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', svg))

    def renamed(match: re.Match[str]) -> str:
        return f' id="{name}-{match[1]}"' if match[1] in used else ""

    svg = re.sub(r'\sid="([^"]+)"', renamed, svg)
    return re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", svg)


BAR_NAME = 24  # letters of a line of a bar's name, which has at most three
ONE_LINE = 26  # letters of a parameter's name beside an axis


def bar_panel(
    title: str,
    x_label: str,
    names: Sequence[str],
    values: Sequence[float],
    texts: Sequence[str],
    strong: Sequence[bool],
) -> Figure:
    """Horizontal bars from the top, each with its value at the end; `strong` ones are highlighted."""
    labels = [fill(short(name, 80), BAR_NAME, max_lines=3, placeholder="…") for name in names]
    lines = max((1 + label.count("\n") for label in labels), default=1)
    height = 0.6 + max(0.29, 0.155 * lines) * len(names)
    figure, axes = panel(short(title), short(x_label), "", height=height)
    rows = list(range(len(names)))
    lengths = np.nan_to_num(np.asarray(values, dtype=float))
    axes.barh(rows, lengths, height=0.66, color=[MARK if s else MODEL for s in strong])
    reach = max(float(lengths.max(initial=0.0)), 1e-300)
    for row, length, text in zip(rows, lengths, texts, strict=True):
        axes.text(length + 0.02 * reach, row, text, va="center", fontsize=9.0, color=INK)
    axes.set_xlim(0.0, 1.28 * reach)
    axes.set_yticks(rows, labels)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    return figure


def _in_two_lines(name: str) -> str:
    """The name of a parameter, with a line break after its place if it is long."""
    place, _, rest = name.partition(".")
    return short(name, ONE_LINE) if len(name) <= ONE_LINE else f"{short(place, ONE_LINE)}.\n{short(rest, ONE_LINE)}"


def ellipse_panel(
    names: tuple[str, str],
    units: tuple[str, str],
    centre: np.ndarray,
    covariance: np.ndarray,
    truth: tuple[float, float] | None = None,
) -> Figure:
    """50 % and 95 % confidence regions of two parameters (chi^2 with two degrees of freedom), and the true values."""
    labels = [f"{_in_two_lines(n)}{', ' + u if u else ''}" for n, u in zip(names, units, strict=True)]
    figure, axes = panel("", labels[0], labels[1], height=2.7)
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    circle = np.stack((np.cos(angle), np.sin(angle)))
    for share, alpha in ((0.95, 0.14), (0.5, 0.24)):
        reach = np.sqrt(-2.0 * np.log(1.0 - share) * np.maximum(values, 0.0))
        x, y = centre[:, None] + (vectors * reach) @ circle
        axes.fill(x, y, facecolor=MODEL, alpha=alpha, edgecolor="none")
        axes.plot(x, y, color=MODEL, lw=1.0)
    axes.plot(*centre, "o", color=MODEL, ms=4)
    if truth is not None:
        axes.plot(*truth, "+", color=OTHER, ms=10, mew=2.0)
    axes.locator_params(nbins=4)
    return figure
