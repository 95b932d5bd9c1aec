"""Several recordings as one trajectory: each starts anew, on its own clock, and nothing is handed on at the joints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fdi_torch.parameters import ParameterSpace
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.collocation import Collocation, Linearised


def own_name(name: str, recording: int) -> str:
    """What a constant that differs from recording to recording is called: 'L.start_level', 'L.start_level@1' ..."""
    return name if recording == 0 else f"{name}@{recording}"


class Joint:
    """What `Collocation` is for one recording, for several.

    space: all parameters; names with '@k' belong to recording k alone, and what bears that name without '@' to
    recording 0. own: names that each recording has for itself. Levels (L, N, tanks) follow each other, recording by
    recording; readings likewise, with one blank sample (0) between recordings, which a mask has to leave out.
    """

    def __init__(self, parts: Sequence[Collocation], space: ParameterSpace) -> None:
        """parts: one engine a recording, the names in its space without '@'."""
        self.parts, self.space = tuple(parts), space
        self._columns = [
            torch.tensor([space.index(n if (m := own_name(n, k)) not in space else m) for n in part.space.names])
            for k, part in enumerate(parts)
        ]
        self._nodes = [len(part.experiment.nodes) for part in parts]

    @property
    def network(self) -> TankNetwork:
        """The plant, the same in all recordings but for what each has for itself."""
        return self.parts[0].network

    def linearise(self, theta: Tensor, levels: Tensor) -> Linearised:
        """theta (L, P), levels (L, N, tanks) a guess -> one Newton step further, with slopes."""
        pieces = zip(self.parts, self._own(theta), self._split(levels), strict=True)
        return self._joined([part.linearise(own, piece) for part, own, piece in pieces])

    def corrected(self, theta: Tensor, levels: Tensor) -> tuple[Tensor, Tensor]:
        """The levels of `linearise` and their defect, without slopes."""
        pieces = zip(self.parts, self._own(theta), self._split(levels), strict=True)
        found = [part.corrected(own, piece) for part, own, piece in pieces]
        return torch.cat([f[0] for f in found], dim=1), torch.stack([f[1] for f in found]).amax(dim=0)

    def settle(self, theta: Tensor, levels: Tensor, rounds: int = 12) -> Linearised:
        """Newton steps at fixed theta from levels (L, N, tanks) in m until those of every recording have settled."""
        pieces = zip(self.parts, self._own(theta), self._split(levels), strict=True)
        return self._joined([part.settle(own, piece, rounds) for part, own, piece in pieces])

    def driven(self, theta: Tensor, levels: Tensor, tank: int) -> Tensor:
        """levels (L, N, tanks) with that of one tank as the model has it while all others are what they are."""
        pieces = zip(self.parts, self._own(theta), self._split(levels), strict=True)
        return torch.cat([part.driven(own, piece, tank) for part, own, piece in pieces], dim=1)

    def rates(self, middle: Tensor, theta: Tensor) -> Tensor:
        """dh/dt (L, N-1, tanks) at given mid-step levels; 0 at the joints."""
        pieces = torch.split(_with_last(middle), self._nodes, dim=1)
        rates = [p.rates(m[:, :-1], own) for p, m, own in zip(self.parts, pieces, self._own(theta), strict=True)]
        return with_blanks(rates)

    def read(self, levels: Tensor, theta: Tensor) -> Tensor:
        """Readings (L, S, C) of given levels (L or 1, N, tanks)."""
        pieces = zip(self.parts, self._split(levels), self._own(theta), strict=True)
        return with_blanks([part.read(piece, own) for part, piece, own in pieces])

    def apart(self, theta: Tensor, near: Linearised) -> list[tuple[Collocation, Tensor, Linearised]]:
        """Each recording's engine, parameters and what of a joint trajectory is its own, slopes left out."""
        steps = (torch.split(_with_last(x), self._nodes, dim=1) for x in (near.transition, near.gain))
        transition, gain = ([piece[:, :-1] for piece in pieces] for pieces in steps)
        pieces = zip(self.parts, self._own(theta), self._split(near.levels), transition, gain, strict=True)
        nothing = near.defect.new_zeros(0)
        return [
            (part, own, Linearised(levels, nothing, nothing, nothing, t, g, near.defect))
            for part, own, levels, t, g in pieces
        ]

    def constant_guess(self, theta: Tensor) -> Tensor:
        """Levels that stay where they start (L, N, tanks)."""
        own = zip(self.parts, self._own(theta), strict=True)
        return torch.cat([part.constant_guess(columns) for part, columns in own], dim=1)

    def _own(self, theta: Tensor) -> list[Tensor]:
        return [theta[..., columns] for columns in self._columns]

    def _split(self, levels: Tensor) -> tuple[Tensor, ...]:
        return torch.split(levels, self._nodes, dim=1)

    def _joined(self, found: Sequence[Linearised]) -> Linearised:
        slopes = [self._spread(f.slopes, k) for k, f in enumerate(found)]
        return Linearised(
            levels=torch.cat([f.levels for f in found], dim=1),
            slopes=torch.cat(slopes, dim=1),
            readings=with_blanks([f.readings for f in found]),
            jacobian=with_blanks([self._spread(f.jacobian, k) for k, f in enumerate(found)]),
            transition=with_blanks([f.transition for f in found]),
            gain=with_blanks([f.gain for f in found]),
            defect=torch.stack([f.defect for f in found]).amax(dim=0),
        )

    def _spread(self, own: Tensor, recording: int) -> Tensor:
        """Slopes by a recording's own parameters (..., p) -> by all of them (..., P)."""
        spread = own.new_zeros(*own.shape[:-1], len(self.space))
        return spread.index_copy_(-1, self._columns[recording], own)


def with_blanks(pieces: Sequence[Tensor], dim: int = 1) -> Tensor:
    """(..., n_k, ...) one after the other along a dimension, one row of zeros between."""
    if len(pieces) == 1:
        return pieces[0]
    rows = [pieces[0]]
    for piece in pieces[1:]:
        rows += [torch.zeros_like(piece.narrow(dim, 0, 1)), piece]
    return torch.cat(rows, dim=dim)


def _with_last(x: Tensor) -> Tensor:
    """One more row, so that each recording has as many rows as nodes."""
    return torch.cat([x, x[:, -1:]], dim=1)
