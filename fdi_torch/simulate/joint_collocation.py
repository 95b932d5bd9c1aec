"""Collocation over several recordings, each with its own initial state and clock."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fdi_torch.parameters import ParameterSpace, name_in_recording
from fdi_torch.plant.network import TankNetwork
from fdi_torch.simulate.collocation import Collocation
from fdi_torch.simulate.linearised import Linearised


class JointCollocation:
    """The interface of `Collocation` for several recordings.

    space: all parameters; a name with '@k' belongs to recording k alone, the same name without '@' then to recording 0.
    Levels (L, N, tanks) of the recordings are concatenated; so are readings, with a blank sample (0) between
    recordings, which a mask must exclude.
    """

    def __init__(self, parts: Sequence[Collocation], space: ParameterSpace) -> None:
        """parts: one collocation per recording, with names without '@' in its space."""
        self.parts, self.space = tuple(parts), space
        own = [[self._joint_name(n, k) for n in part.space.names] for k, part in enumerate(parts)]
        by = [[self._joint_name(n, k) for n in part.by] for k, part in enumerate(parts)]
        self.by = tuple(n for n in space.names if any(n in names for names in by))
        self._columns = [torch.tensor([space.index(n) for n in names]) for names in own]
        self._slope_columns = [torch.tensor([self.by.index(n) for n in names], dtype=torch.int64) for names in by]
        self._nodes = [len(part.experiment.nodes) for part in parts]

    def _joint_name(self, name: str, recording: int) -> str:
        """The name of a parameter of one recording in the space of all."""
        return own if (own := name_in_recording(name, recording)) in self.space else name

    @property
    def network(self) -> TankNetwork:
        """The plant of the first recording; the others differ only in the constants of each recording."""
        return self.parts[0].network

    def linearise(self, theta: Float[Tensor, "L P"], levels: Float[Tensor, "L N n"]) -> Linearised:
        """theta (L, P) and an approximate trajectory levels (L, N, tanks) -> one Newton step, with derivatives."""
        pieces = zip(self.parts, self._own(theta), self._split(levels), strict=True)
        return self._joined([part.linearise(columns, piece) for part, columns, piece in pieces])

    def converge(self, theta: Float[Tensor, "L P"]) -> Linearised:
        """The trajectories at theta, with derivatives."""
        pairs = zip(self.parts, self._own(theta), strict=True)
        return self._joined([part.converge(columns) for part, columns in pairs])

    def trajectories(
        self, theta: Float[Tensor, "L P"], guess: Float[Tensor, "L N n"] | None = None
    ) -> Float[Tensor, "L N n"]:
        """The trajectories at theta, m."""
        guesses = [None] * len(self.parts) if guess is None else self._split(guess)
        pieces = zip(self.parts, self._own(theta), guesses, strict=True)
        return torch.cat([part.trajectories(columns, piece) for part, columns, piece in pieces], dim=1)

    def simulate_tank(
        self, theta: Float[Tensor, "L P"], levels: Float[Tensor, "L N tanks"], tank: int
    ) -> Float[Tensor, "L N n"]:
        """Levels (L, N, tanks), m, with those of one tank computed from the given levels of all others."""
        pieces = zip(self.parts, self._own(theta), self._split(levels), strict=True)
        return torch.cat([part.simulate_tank(columns, piece, tank) for part, columns, piece in pieces], dim=1)

    def rates(self, middle: Float[Tensor, "#L K m"], theta: Float[Tensor, "L P"]) -> Float[Tensor, "L K n"]:
        """dh/dt (L, N-1, tanks), m/s, at given mid-step levels; 0 between recordings."""
        pieces = torch.split(_with_last(middle), self._nodes, dim=1)
        rates = [
            p.rates(m[:, :-1], columns) for p, m, columns in zip(self.parts, pieces, self._own(theta), strict=True)
        ]
        return with_blanks(rates)

    def read(self, levels: Float[Tensor, "#L N n"], theta: Float[Tensor, "L P"]) -> Float[Tensor, "L S C"]:
        """Readings (L, S, C) of given levels (L or 1, N, tanks)."""
        pieces = zip(self.parts, self._split(levels), self._own(theta), strict=True)
        return with_blanks([part.read(piece, columns) for part, piece, columns in pieces])

    def apart(self, theta: Tensor, near: Linearised) -> list[tuple[Collocation, Tensor, Linearised]]:
        """For each recording, its collocation, its parameters and its part of a joint trajectory, without slopes."""
        steps = (torch.split(_with_last(x), self._nodes, dim=1) for x in (near.transition, near.gain))
        transition, gain = ([piece[:, :-1] for piece in pieces] for pieces in steps)
        pieces = zip(self.parts, self._own(theta), self._split(near.levels), transition, gain, strict=True)
        nothing = near.defect.new_zeros(0)
        return [
            (part, columns, Linearised(levels, nothing, nothing, nothing, t, g, near.defect, nothing))
            for part, columns, levels, t, g in pieces
        ]

    def _own(self, theta: Tensor) -> list[Tensor]:
        return [theta[..., columns] for columns in self._columns]

    def _split(self, levels: Tensor) -> tuple[Tensor, ...]:
        return torch.split(levels, self._nodes, dim=1)

    def _joined(self, parts: Sequence[Linearised]) -> Linearised:
        slopes = [self._spread(f.slopes, k) for k, f in enumerate(parts)]
        return Linearised(
            levels=torch.cat([f.levels for f in parts], dim=1),
            slopes=torch.cat(slopes, dim=1),
            readings=with_blanks([f.readings for f in parts]),
            jacobian=with_blanks([self._spread(f.jacobian, k) for k, f in enumerate(parts)]),
            transition=with_blanks([f.transition for f in parts]),
            gain=with_blanks([f.gain for f in parts]),
            defect=torch.stack([f.defect for f in parts]).amax(dim=0),
            origin=torch.cat([f.origin for f in parts], dim=1),
        )

    def _spread(self, slopes: Tensor, recording: int) -> Tensor:
        """Slopes by one recording's parameters (..., p) -> by all parameters (..., P)."""
        full = slopes.new_zeros(*slopes.shape[:-1], len(self.by))
        return full.index_copy_(-1, self._slope_columns[recording], slopes)


def with_blanks(pieces: Sequence[Tensor], dim: int = 1) -> Tensor:
    """Concatenate (..., n_k, ...) along a dimension, with one row of zeros between pieces."""
    if len(pieces) == 1:
        return pieces[0]
    rows = [pieces[0]]
    for piece in pieces[1:]:
        rows += [torch.zeros_like(piece.narrow(dim, 0, 1)), piece]
    return torch.cat(rows, dim=dim)


def _with_last(x: Tensor) -> Tensor:
    """x with its last row repeated, so that each recording has as many rows as nodes."""
    return torch.cat([x, x[:, -1:]], dim=1)
