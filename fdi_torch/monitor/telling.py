"""Findings in words: what changed, by how much, since when."""

from __future__ import annotations

from torch import Tensor

from fdi_torch.monitor.events import Event, Kind
from fdi_torch.monitor.following import Change
from fdi_torch.monitor.isolation import Finding
from fdi_torch.parameters import ParameterSpace


def tell(space: ParameterSpace, change: Change, rivals: tuple[str, ...], now: float, kind: Kind, start: float) -> Event:
    """One event for a change that was found at `now`; `recovered` where everything went back to nominal.

    start: since when the observer runs, s; what began there may have been there before.
    """
    finding, names = change.finding, names_of(space, change.finding)
    columns = finding.hypothesis.columns
    back = [
        c
        for c in finding.hypothesis.sizes
        if is_nominal(space, finding, c) and float(change.before[c]) != _nominal(space, c)
    ]
    sizes = tuple(float(finding.value[c]) for c in columns)
    stds = tuple(float(finding.std[c]) for c in columns)
    units = tuple(space.parameters[c].unit for c in columns)
    told: Kind = "recovered" if len(back) == len(finding.hypothesis.sizes) else kind
    return Event(
        now, told, _text(finding, names, sizes, stds, units, rivals, start), names, sizes, stds, units, finding.onset,
        finding.onset_std, finding.hypothesis.incipient, change.alarm - finding.onset, rivals,
    )  # fmt: skip


def names_of(space: ParameterSpace, finding: Finding) -> tuple[str, ...]:
    return tuple(space.names[c] for c in finding.hypothesis.columns)


def is_nominal(space: ParameterSpace, finding: Finding, column: int) -> bool:
    """Whether what was found is nominal, to three standard errors."""
    return abs(float(finding.value[column]) - _nominal(space, column)) <= 3.0 * float(finding.std[column])


def with_nominals(space: ParameterSpace, finding: Finding) -> Tensor:
    """Values (P,) to believe in: what is nominal within its error is taken for nominal."""
    believed = finding.value.clone()
    for c in finding.hypothesis.sizes:
        if is_nominal(space, finding, c):
            believed[c] = _nominal(space, c)
    return believed


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
    return f"{name} = {size:.4g} ± {std:.2g}" + ("" if unit == "1" else f" {unit}")
