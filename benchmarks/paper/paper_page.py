"""The page about the paper: all run files are computed, then written as Markdown with pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.paper import paper_tables
from benchmarks.paper.modes import Modes, confusion, diagnose_modes, mode_name
from benchmarks.paper.online import TIME_BETWEEN_FALSE_ALARMS, OnLine, follow
from benchmarks.paper.paper_figures import (
    confusion_figure,
    convergence_figure,
    correlation_figure,
    outputs_figure,
    residuals_figure,
)
from benchmarks.paper.published import SYMBOLS, TABLE_2, TABLE_3
from benchmarks.paper.table_cases import Case, shipped_run, solve
from fdi_torch.disk import write_text
from fdi_torch.report.style import save

WINDOWS = ("nominal", "table2_2d", "table3_snr50")
"""Run files of Figures 6 and 7, one per window."""
MODES, DRAWS = "modes", 4
TO_CM = 100.0

Tell = Callable[[float, str], None]


@dataclass(frozen=True)
class Results:
    """All results that the page shows."""

    table_2: tuple[Case, ...]
    table_3: tuple[Case, ...]
    online: OnLine
    modes: Modes


def make_page(folder: Path, tell: Tell) -> list[Path]:
    """Compute and write the page. tell(share, text): progress. Returns the files, the page first."""
    results = solve_all(tell)
    tell(0.97, "drawing")
    pictures = draw(results, folder)
    page = folder / "README.md"
    return [write_text(page, text_of(results)), *pictures]


def solve_all(tell: Tell) -> Results:
    names = [*TABLE_2, *TABLE_3]
    cases = []
    for k, name in enumerate(names):
        tell(0.7 * k / len(names), name)
        cases.append(solve(shipped_run(name)))
    tell(0.7, "Figures 6 and 7")
    online = follow([shipped_run(name) for name in WINDOWS])
    tell(0.85, "31 fault modes")
    modes = diagnose_modes(shipped_run(MODES), DRAWS)
    return Results(tuple(cases[: len(TABLE_2)]), tuple(cases[len(TABLE_2) :]), online, modes)


def draw(results: Results, folder: Path) -> list[Path]:
    """Write every figure as PNG."""
    low, high = results.table_3[-1], results.table_3[0]
    online = results.online
    time, read = online.recording.time.numpy(), TO_CM * online.recording.outputs.numpy()
    changes = [w.begin for w in online.windows[1:]]
    alarms = [w.alarm for w in online.windows if w.alarm is not None]
    nominal, adaptive = TO_CM * online.nominal.numpy(), TO_CM * online.adaptive.numpy()
    fitted = read - TO_CM * online.predicted.numpy()
    modes = [mode_name(mode) for mode in results.modes.modes]
    figures = {
        "figure_3": _correlation(results.table_3),
        "figure_4": _convergence(low),
        "figure_5": _convergence(high),
        "figure_6": outputs_figure(time, read, TO_CM * online.predicted.numpy(), changes),
        "figure_7": residuals_figure(time, nominal, adaptive, fitted, changes, alarms),
        "fault_modes": confusion_figure(confusion(results.modes).numpy(), modes, ["none", *modes]),
    }
    return [save(figure, folder / f"{name}.png") for name, figure in figures.items()]


def _correlation(cases: tuple[Case, ...]):  # type: ignore[no-untyped-def]
    snr, correlations = np.array([c.snr_db for c in cases]), np.array([c.correlation for c in cases])
    axis = np.linspace(0.0, 60.0, 200)
    return correlation_figure(snr, correlations, axis, 3.0 / np.sqrt(1.0 + 10.0 ** (-axis / 10.0)))


def _convergence(case: Case):  # type: ignore[no-untyped-def]
    title = f"Estimates over the search, SNR {case.snr_db:g} dB"
    return convergence_figure(case.history.numpy(), case.refined.numpy(), case.truth.numpy(), SYMBOLS, title)


def text_of(results: Results) -> str:
    """The page as Markdown."""
    worst = max(float((c.refined - c.truth).abs().max()) for c in results.table_2)
    searched = max(float((c.searched - c.truth).abs().max()) for c in results.table_2)
    right = float(results.modes.right.double().mean())
    return PAGE.format(
        worst=paper_tables.error(worst),
        searched=paper_tables.error(searched),
        table_2=paper_tables.table_2(results.table_2, TABLE_2),
        correlations_2=paper_tables.correlations(results.table_2),
        table_3=paper_tables.table_3(results.table_3, TABLE_3),
        correlations_3=paper_tables.correlations(results.table_3),
        windows=paper_tables.windows(results.online),
        run_length=f"{TIME_BETWEEN_FALSE_ALARMS:g}",
        alarms=_alarms(results.online),
        draws=DRAWS,
        right=f"{100 * right:.1f} %",
        wrong=paper_tables.wrongly_named(results.modes),
        dimensions=paper_tables.by_dimension(results.modes),
        equations=paper_tables.equations(),
        errata=paper_tables.errata(),
    )


def _alarms(online: OnLine) -> str:
    early = [w for w in online.windows[:1] if w.alarm is not None]
    first = "One false alarm was raised in it." if early else "No alarm was raised in it."
    scores = [
        float(((w.result.estimate.value[:5] - w.truth) / w.result.estimate.std[:5]).abs().max())
        for w in online.windows
        if w.result is not None
    ]
    return f"{first} Every parameter lies within {max(scores):.1f} standard errors of the truth."


PAGE = """# The paper's tables and figures, made again

"A Nonlinear Adaptive Observer-Based Differential Evolution Algorithm to Multiparameter Fault Diagnosis" (2020).
Everything here is made by `make paper` from the run files under `configs/paper`, seeds included.

The three tanks are simulated by an adaptive solver at a relative tolerance of 1e-10 and estimated with fixed steps,
so data and model are not the same code. *DE alone* is the paper's way: differential evolution on the sum of
correlations (here L-SHADE, steps of 1 s; `estimate.search.strategy: rand/1/bin` is the paper's own variant). *Refined*
goes on from there by Levenberg-Marquardt on the likelihood, within the paper's box. *Standard error* is the estimator's
own; *bound* is the Cramér-Rao bound at the truth, the least that any unbiased estimator can reach. θ₁ leak of tank 1,
θ₂ net outlet of tank 2, θ₃ leak of tank 3, θ₄ and θ₅ openness of the pipes 1–3 and 3–2.

## Table 2: five faults, free of noise

Largest error of the refined estimates: {worst}; of the search alone: {searched}. Without noise a standard error only
reflects integration and rounding errors; the bound says what noise of 50 dB would cost. The search takes steps of 1 s;
where the faults bring tanks 2 and 3 to nearly equal levels (3- to 5-dim), the remaining error is that of these steps.

{table_2}

{correlations_2}

## Table 3: one fault at five noise levels

All noise levels use the same random draw, scaled, so that their errors are not independent. The true θ₅ = 1 is the
upper bound of the search. An estimate that may not exceed this bound is biased, and its error can be smaller than the
Cramér-Rao bound; the last columns show the estimate without bounds.

{table_3}

{correlations_3}

## Figure 3: correlation against noise

![sum of correlations against SNR](figure_3.png)

White noise of a given SNR against the variance leaves 1 / √(1 + 10^(−SNR/10)) of each sensor's correlation, however
good the estimate: the line. A sum below 3 therefore says nothing of the fit as long as the noise is unknown.

## Figures 4 and 5: estimates over the search

Lines: the best member after each generation; diamonds: refined; dashed: the truth.

![estimates over generations, SNR 10 dB](figure_4.png)

![estimates over generations, SNR 50 dB](figure_5.png)

## Figures 6 and 7: two faults one after the other, SNR 50 dB

No fault until 1000 s, then (0.1, 0.6, 0, 1, 1), then from 2000 s (0.3, 0.3, 0.5, 0.6, 1). The paper does not give
its faults; these are rows of its tables. An observer with nominal parameters runs along; a CUSUM of its whitened
residual, set for {run_length} s between false alarms on a fault-free recording of the same noise, raises the alarm.
At the end of a window in which the outputs move, the faults and the start levels are estimated from that window
alone, and go back into the observer (16). In the first window the outputs stand still: correlation and an SNR
against the variance are undefined there, and the residual alone decides. {alarms}

{windows}

![outputs and estimate](figure_6.png)

![residuals](figure_7.png)

Dashed: a fault sets in. Grey: nominal parameters throughout. Blue: the newest parameters go back at the end of each
window, so that the residual begins at zero again at 2000 s, where the next fault sets in. Green: the residual after the
fit of each window, known at its end.

## All 31 fault modes

Every set of the five faults of Table 2's last row, {draws} draws of noise each (SNR 30 dB), all in one batch. A
fault is called present where its parameter is further from nominal than its standard error explains, at 95 % for
the whole statement. Named exactly: {right}. {wrong}

{dimensions}

![fault modes simulated against said](fault_modes.png)

## Equation → code

A test imports every name.

{equations}

## Errata, and what is built instead

{errata}
"""
