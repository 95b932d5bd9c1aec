"""Findings in words: what changed, by how much, since when."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from fdi_torch.monitor.events import Event, Kind
from fdi_torch.monitor.following import Change
from fdi_torch.monitor.hypothesis import Finding
from fdi_torch.parameters import ParameterSpace

RIVAL = 6.0  # difference in BIC below which another explanation stands beside the best


def tell(
    space: ParameterSpace, change: Change, rivals: tuple[str, ...], now: float, kind: Kind, start: float
) -> list[Event]:
    """What is told of a change that was found at `now`: faults that went back to nominal as `recovered`, the others
    as `kind`.

    start: since when the observer runs, s; what began there may have been there before.
    """
    hypothesis = change.finding.hypothesis
    back = [c for c in hypothesis.sizes if is_back(space, change, c)]
    if len(back) == len(hypothesis.sizes):
        return [_event(space, change, hypothesis.columns, rivals, now, "recovered", start)]
    rest = tuple(c for c in hypothesis.columns if c not in back)
    gone = [_event(space, change, tuple(back), (), now, "recovered", start)] if back else []
    return [*gone, _event(space, change, rest, rivals, now, kind, start)]


def rivals_of(space: ParameterSpace, found: Sequence[Finding]) -> tuple[str, ...]:
    """The names of explanations that fit nearly as well as the best, and do not merely add to it."""
    best = found[0]
    near = [f for f in found[1:] if f.score - best.score < RIVAL]
    rivals = [f for f in near if not set(best.hypothesis.columns) <= set(f.hypothesis.columns)]
    return tuple(dict.fromkeys(" + ".join(names_of(space, f)) for f in rivals))


def names_of(space: ParameterSpace, finding: Finding) -> tuple[str, ...]:
    """Parameters that a finding says have changed, by their full names."""
    return tuple(space.names[c] for c in finding.hypothesis.columns)


def is_nominal(space: ParameterSpace, finding: Finding, column: int) -> bool:
    """Whether what was found is nominal, to three standard errors."""
    return abs(float(finding.value[column]) - _nominal(space, column)) <= 3.0 * float(finding.std[column])


def is_back(space: ParameterSpace, change: Change, column: int) -> bool:
    """Whether what was off nominal is nominal now, and the readings tell the two apart."""
    before, value = float(change.before[column]), float(change.finding.value[column])
    apart = abs(before - value) > 3.0 * float(change.finding.std[column])
    return before != _nominal(space, column) and is_nominal(space, change.finding, column) and apart


def with_nominals(space: ParameterSpace, change: Change) -> Tensor:
    """Values (P,) to believe in: nominal where that is within the error, unless a fault that stands is so as well."""
    believed = change.finding.value.clone()
    for c in change.finding.hypothesis.sizes:
        if is_nominal(space, change.finding, c):
            stands = float(change.before[c]) != _nominal(space, c) and not is_back(space, change, c)
            believed[c] = change.before[c] if stands else _nominal(space, c)
    return believed


def _event(
    space: ParameterSpace,
    change: Change,
    columns: tuple[int, ...],
    rivals: tuple[str, ...],
    now: float,
    kind: Kind,
    start: float,
) -> Event:
    finding, names = change.finding, tuple(space.names[c] for c in columns)
    sizes = tuple(float(finding.value[c]) for c in columns)
    stds = tuple(float(finding.std[c]) for c in columns)
    units = tuple(space.parameters[c].unit for c in columns)
    return Event(
        now, kind, _text(finding, names, sizes, stds, units, rivals, start), names, sizes, stds, units, finding.onset,
        finding.onset_std, finding.hypothesis.incipient, change.alarm - finding.onset, rivals,
    )  # fmt: skip


def _nominal(space: ParameterSpace, column: int) -> float:
    return space.parameters[column].nominal


def _text(
    finding: Finding,
    names: tuple[str, ...],
    sizes: tuple[float, ...],
    stds: tuple[float, ...],
    units: tuple[str, ...],
    rivals: tuple[str, ...],
    start: float,
) -> str:
    parts = [_amount(*row) for row in zip(names, sizes, stds, units, strict=True)]
    manner = "growing since" if finding.hypothesis.incipient else "since"
    text = f"{', '.join(parts)}, {manner} {finding.onset:.1f} ± {finding.onset_std:.2g} s"
    if finding.onset - start <= 2.0 * max(finding.onset_std, 0.5):
        text += ", where the observer starts: it may have been there before"
    if rivals:
        text += f"; or {' or '.join(rivals)}"
    if not finding.fits:
        text += "; does not explain all of the residual"
    return text


def _amount(name: str, size: float, std: float, unit: str) -> str:
    amount = f"{name} = {size:.4g} ± {std:.2g}" if std > 0.0 else f"{name} = {size:.4g}"
    return amount + ("" if unit == "1" else f" {unit}")
