"""The page's tables as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from torch import Tensor

from benchmarks.paper.equations import EQUATIONS, ERRATA, STATEMENTS
from benchmarks.paper.modes import Modes, mode_name
from benchmarks.paper.online import OnLine
from benchmarks.paper.published import SYMBOLS
from benchmarks.paper.table_cases import BOUND_SNR, Case

MISPRINT = "misprint"
ROUNDING = 1e-7


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A Markdown table whose first `left` columns are left-aligned."""
    rule = [":---" if i < left else "---:" for i in range(len(header))]
    lines = [header, rule, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def table_2(cases: Sequence[Case], published: Mapping[str, Sequence[float | None]]) -> str:
    """One row per parameter of each noise-free fault."""
    header = ("fault", "", "true", "paper", "DE alone", "refined", "paper's error", "DE's error", "refined error",
              "standard error", f"bound at {BOUND_SNR:g} dB")  # fmt: skip
    return markdown(header, (row for case in cases for row in _rows(case, published[case.name], _dimension(case))), 2)


def table_3(cases: Sequence[Case], published: Mapping[str, Sequence[float | None]]) -> str:
    """One row per parameter and SNR, with the bounded and the unbounded estimate."""
    header = ("SNR", "", "true", "paper", "DE alone", "refined", "paper's error", "DE's error", "refined error",
              "standard error", "bound", "without bounds", "its error / bound")  # fmt: skip
    rows = []
    for case in cases:
        for i, row in enumerate(_rows(case, published[case.name], f"{case.snr_db:g} dB")):
            score = float((case.free[i] - case.truth[i]) / case.bound[i])
            rows.append([*row, fixed(case.free[i]), f"{score:+.2f}"])
    return markdown(header, rows, 2)


def correlations(cases: Sequence[Case]) -> str:
    """Sum of correlations after the search and at the refined estimate, and status of the estimate."""
    header = ("run file", "after DE", "refined", "generations", "step of search, refinement", "status")
    rows = [
        (
            f"`{case.name}`",
            f"{case.searched_correlation:.9f}",
            f"{case.correlation:.9f}",
            str(len(case.history)),
            f"{case.steps[0]:g} s, {case.steps[1]:g} s",
            case.status,
        )
        for case in cases
    ]
    return markdown(header, rows)


def by_dimension(result: Modes) -> str:
    """Share of correctly named modes and root mean square errors, by number of faults."""
    header = ("faults at once", "modes", "draws", "named exactly", "faults missed", "faults invented", "DE alone, RMSE",
              "refined, RMSE", "errors / standard error, RMS")  # fmt: skip
    size = result.modes.sum(-1)
    groups = [size == k for k in range(1, int(size.max()) + 1)] + [size > 0]
    names = [str(k) for k in range(1, int(size.max()) + 1)] + ["all"]
    return markdown(header, [_group(result, chosen, name) for chosen, name in zip(groups, names, strict=True)])


def _group(result: Modes, chosen: Tensor, name: str) -> list[str]:
    there, said = result.modes[chosen].unsqueeze(1), result.stated[chosen]
    searched, refined = (part[chosen] - result.truth[chosen].unsqueeze(1) for part in (result.searched, result.refined))
    # At an end of the box an estimate is held, and its error is not that of a free one.
    inside = there.expand_as(refined) & (result.refined[chosen] < 1.0) & (result.refined[chosen] > 0.0)
    scaled = (refined / result.std[chosen])[inside]
    return [
        name,
        str(int(chosen.sum())),
        str(said.shape[0] * said.shape[1]),
        f"{100 * float(result.right[chosen].double().mean()):.1f} %",
        str(int((there & ~said).sum())),
        str(int((~there & said).sum())),
        f"{float(searched.square().mean().sqrt()):.5f}",
        f"{float(refined.square().mean().sqrt()):.5f}",
        f"{float(scaled.square().mean().sqrt()):.2f}",
    ]


def wrongly_named(result: Modes) -> str:
    """Every draw whose faults were not named correctly."""
    wrong = (~result.right).nonzero().tolist()
    said = [f"{mode_name(result.modes[m])} was named {mode_name(result.stated[m, d])}" for m, d in wrong]
    return f"Wrong draws, by the numbers of their faults: {'; '.join(said)}." if said else "No draw was named wrongly."


def windows(online: OnLine) -> str:
    """Alarms, delays and estimates of each window."""
    header = ("window, s", "alarm", "", "true", "estimate", "standard error", "error / standard error", "correlation")
    rows = []
    for window in online.windows:
        span = f"{window.begin:g} to {window.end:g}"
        alarm = "none" if window.alarm is None else f"{window.alarm:g} s (delay {window.delay:g} s)"
        if window.result is None:
            rows.append((span, alarm, "", "", "outputs stand still", "", "", "undefined"))
            continue
        final, total = window.result.estimate, float(window.result.correlation.sum())
        for i, symbol in enumerate(SYMBOLS):
            value, std, true = float(final.value[i]), float(final.std[i]), float(window.truth[i])
            first = (span, alarm) if i == 0 else ("", "")
            rho = f"{total:.6f}" if i == 0 else ""
            rows.append((*first, symbol, f"{true:g}", fixed(value), f"{std:.1e}", f"{(value - true) / std:+.2f}", rho))
    return markdown(header, rows, 3)


def equations() -> str:
    """Equation -> code."""
    entries = [(e.label, e.says, e.places) for e in EQUATIONS]
    rows = [(what, says, _code(places)) for what, says, places in (*STATEMENTS, *entries)]
    return markdown(("equation", "what it says", "where it lives (below `fdi_torch`)"), rows, 3)


def _code(places: Sequence[str]) -> str:
    return ", ".join(f"`{place}`" for place in places) or "not built"


def errata() -> str:
    return markdown(("where", "what is wrong", "what is built"), ERRATA, 3)


def error(value: float | Tensor, sign: str = "") -> str:
    """Two digits; smaller values are reported as below rounding, because their digits depend on the machine."""
    return f"< {ROUNDING:g}" if abs(float(value)) < ROUNDING else f"{float(value):{sign}.1e}"


def fixed(value: float | Tensor) -> str:
    return f"{float(value):.6f}"


def _dimension(case: Case) -> str:
    """'table2_3d' -> '3-dim'."""
    return case.name.removeprefix("table2_").removesuffix("d") + "-dim"


def _rows(case: Case, published: Sequence[float | None], first: str) -> list[list[str]]:
    rows = []
    for i, (symbol, theirs) in enumerate(zip(SYMBOLS, published, strict=True)):
        true = float(case.truth[i])
        errors = [
            None if theirs is None else theirs - true,
            *(float(v[i]) - true for v in (case.searched, case.refined)),
        ]
        rows.append(
            [
                first if i == 0 else "",
                symbol,
                f"{true:g}",
                MISPRINT if theirs is None else fixed(theirs),
                fixed(case.searched[i]),
                fixed(case.refined[i]),
                *("–" if e is None else error(e, "+") for e in errors),
                error(case.std[i]),
                error(case.bound[i]),
            ]
        )
    return rows
