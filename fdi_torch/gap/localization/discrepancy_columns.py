"""The influence of a component's regressors on the readings, as the columns of a linear regression."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fdi_torch.simulate.linearised import Linearised


@dataclass(frozen=True)
class Columns:
    """Columns (S, C, M) in blocks (S, C, .), so that a change of one block copies no other."""

    blocks: tuple[Tensor, ...]

    def __len__(self) -> int:
        return sum(b.shape[-1] for b in self.blocks)

    def __getitem__(self, used: Tensor) -> Tensor:
        """The columns (S, C, number used) for which used (M,) is True."""
        parts = used.split([b.shape[-1] for b in self.blocks])
        return torch.cat([b[..., part] for b, part in zip(self.blocks, parts, strict=True)], dim=-1)


@dataclass(frozen=True)
class Position:
    """A regressor that lies between two of the grid.

    family, index: which of `DiscrepancyRegression.families`, and its number there. choices: number of regressors among
    which it was selected. parameters: of a relay or pulse that was moved. frequency: of a pulse, Hz.
    """

    family: int
    index: int
    choices: int
    parameters: tuple[float, ...] | None = None
    frequency: float | None = None


@dataclass(frozen=True)
class Selection:
    """Which regressors a discrepancy uses, whatever the trajectory about which the plant is linearised.

    precision (M,): of their priors, infinite for those that are not used. positions: of the last regressors, which lie
    between those of the grid. frequency: of the sinusoids, Hz, or None if there are none.
    """

    precision: Tensor
    positions: tuple[Position, ...]
    frequency: float | None

    @property
    def frequencies(self) -> tuple[float, ...]:
        return () if self.frequency is None else (self.frequency,)


@dataclass(frozen=True)
class Discrepancy:
    """Influence of a component's regressors on the readings, columns (S, C, M), about a linearised trajectory.

    regressor (M,): which one each column belongs to; columns of one regressor have coefficients of the same variance.
    choices (M,): number of regressors among which it was selected. frequency: of the sinusoids, Hz, or None if there
    are none. sinusoids (M,) bool: which columns they are. positions: of the last columns.
    """

    columns: Columns
    linearised: Linearised
    regressor: Tensor
    choices: Tensor
    frequency: float | None
    sinusoids: Tensor
    positions: tuple[Position, ...] = ()

    def with_column(self, column: Tensor, position: Position) -> Discrepancy:
        """The columns and one more (S, C), of a regressor at a position between those of the grid."""
        return replace(
            self,
            columns=Columns((*self.columns.blocks, column.unsqueeze(-1))),
            regressor=torch.cat([self.regressor, self.regressor[-1:] + 1]),
            choices=torch.cat([self.choices, self.choices.new_tensor([position.choices])]),
            sinusoids=torch.cat([self.sinusoids, self.sinusoids.new_zeros(1)]),
            positions=(*self.positions, position),
        )

    def selection(self, precision: Tensor) -> Selection:
        """The regressors in use. precision (M,): infinite for those that are not."""
        used, grid = torch.isfinite(precision), len(precision) - len(self.positions)
        positions = tuple(p for p, kept in zip(self.positions, used[grid:].tolist(), strict=True) if kept)
        oscillates = bool((used & self.sinusoids).any())
        on_grid = precision[:grid] if oscillates else precision[:grid][~self.sinusoids[:grid]]
        frequency = self.frequency if oscillates else None
        return Selection(torch.cat([on_grid, precision[grid:][used[grid:]]]), positions, frequency)

    def with_sinusoids(self, frequency: float, columns: Tensor) -> Discrepancy:
        """The columns with sinusoids of another frequency; columns (S, C, W): their influence."""
        grid, _, *added = self.columns.blocks
        return replace(self, columns=Columns((grid, columns, *added)), frequency=frequency)
