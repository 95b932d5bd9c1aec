"""Recording: time, inputs, outputs and their origin, in SI."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch

from fdi_torch.clock import stamp
from fdi_torch.tables import Shown, Table, in_display_unit, in_its_units, needed

Hold = Literal["zero_order", "linear"]
LONGEST, LARGEST = 5e9, 1e12
"""Limits of |time| (s, including seconds since 1970) and of |channels| (SI); larger numbers have a wrong unit."""


@dataclass(frozen=True, repr=False)
class Recording(Shown):
    """Commands and readings of a rig, on one clock.

    - time (T,), s: strictly increasing.
    - inputs (T, M), outputs (T, N): in the SI units `input_units` and `output_units`. An unknown input is NaN, and
      `known_segments` cuts the recording there.
    - mask (T, N): True for valid readings. A missing reading is False here and NaN in outputs.
    - hold: course of the inputs between samples, held or linear.
    - source, sha256: name and hash of the file; a recording in memory has no hash.
    - ran: inputs that were, or may have been, on before the first sample, known where this recording was cut from a
      longer one.
    - notes: corrections that the reader of the file made, one sentence each.
    - began: time 0 in seconds since 1970, if known. zone: how far the file's clock is ahead of UTC, s.
    - trusted: whether the checks for wrong units, swapped channels and clock errors are skipped.
    - written: the units in which the file has each channel, and the time `t`.
    """

    time: torch.Tensor
    inputs: torch.Tensor
    outputs: torch.Tensor
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    mask: torch.Tensor = field(default=None)  # type: ignore[assignment]
    hold: Hold = "zero_order"
    source: str = "memory"
    sha256: str = ""
    ran: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    began: float | None = None
    zone: float = 0.0
    trusted: bool = False
    written: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        for given in (self.time, self.inputs, self.outputs):
            if not isinstance(given, torch.Tensor):
                raise TypeError(
                    f"{self.source}: expected time, inputs and outputs to be tensors, got a {type(given).__name__}; "
                    "convert it by torch.tensor(..., dtype=torch.float64)"
                )
        if self.mask is None:
            object.__setattr__(self, "mask", torch.ones_like(self.outputs, dtype=torch.bool))
        samples = len(self.time)
        for name, tensor, width in (
            ("inputs", self.inputs, len(self.input_names)),
            ("outputs", self.outputs, len(self.output_names)),
            ("mask", self.mask, len(self.output_names)),
        ):
            if tuple(tensor.shape) != (samples, width):
                raise ValueError(
                    f"{self.source}: expected {name} of shape {(samples, width)}, got {tuple(tensor.shape)}"
                )
        object.__setattr__(self, "mask", self.mask & torch.isfinite(self.outputs))
        beyond = self.time[~(self.time.abs() <= LONGEST)]
        if len(beyond):
            raise ValueError(
                f"{self.source}: expected times within {LONGEST:g} s, got {float(beyond[0]):g} s; correct the clock"
            )
        for name, tensor in (("inputs", self.inputs), ("readings", self.outputs)):
            beyond = tensor[torch.isfinite(tensor) & (tensor.abs() > LARGEST)]
            if len(beyond):
                raise ValueError(
                    f"{self.source}: expected {name} within {LARGEST:g} in SI units, got {float(beyond[0]):g}; "
                    "correct the unit or the numbers"
                )
        steps = torch.diff(self.time)
        if not bool((steps > 0).all()):
            row = int((steps <= 0).nonzero()[0]) + 1
            raise ValueError(
                f"{self.source}: expected time that increases, got {float(self.time[row - 1]):g} s followed by "
                f"{float(self.time[row]):g} s in sample {row}; sort the rows or drop the repeated ones"
            )

    def __len__(self) -> int:
        return len(self.time)

    @property
    def readings(self) -> torch.Tensor:
        """The outputs (T, N), NaN where masked."""
        return torch.where(self.mask, self.outputs, torch.nan)

    def input_columns(self, names: Sequence[str]) -> list[int]:
        """Columns of these inputs. Raises ValueError for one that is not recorded."""
        return self._indices("an input", names, self.input_names)

    def output_columns(self, names: Sequence[str]) -> list[int]:
        """Columns of these outputs. Raises ValueError for one that is not recorded."""
        return self._indices("a sensor", names, self.output_names)

    def _indices(self, kind: str, names: Sequence[str], present: Sequence[str]) -> list[int]:
        for name in names:
            if name not in present:
                got = ", ".join(present) or "none"
                raise ValueError(f"{self.source}: expected {kind} '{name}', got {got}; map the column to it")
        return [present.index(name) for name in names]

    def valid_readings(self, name: str) -> torch.Tensor:
        """The valid readings (K,) of an output; none if it is not recorded."""
        if name not in self.output_names:
            return self.outputs.new_zeros(0)
        column = self.output_names.index(name)
        return self.outputs[self.mask[:, column], column]

    @property
    def headline(self) -> str:
        lasts = float(self.time[-1] - self.time[0]) if len(self) else 0.0
        return f"{self.source}: {len(self)} samples, {lasts:g} s, one every {self.interval:g} s"

    @property
    def shown_units(self) -> Mapping[str, str]:
        return {**self._made_in, **self.written}

    @in_its_units
    def table(self) -> Table:
        """One row per channel: role, unit, range in that unit and number of missing samples."""
        rows = [
            (name, role, *in_display_unit(name, unit, *_range(values)), int((~torch.isfinite(values)).sum()))
            for role, names, units, table in (
                ("input", self.input_names, self.input_units, self.inputs),
                ("output", self.output_names, self.output_units, self.readings),
            )
            for name, unit, values in zip(names, units, table.T, strict=True)
        ]
        return Table(("channel", "role", "unit", "lowest", "highest", "missing"), rows)

    def __repr__(self) -> str:
        return "\n".join([super().__repr__(), *(f"- {note}" for note in self.notes)])

    def to_pandas(self, own_units: bool = False) -> Any:
        """A pandas.DataFrame (extra `pandas`): one column per channel in SI, indexed by time in s; masked readings are
        NaN.

        Its `attrs["units"]` holds the unit of each column. own_units: in the units in which the channels were written,
        which the columns name: 'h1 [cm]'. `read_frame` reads both.
        """
        frame = needed("pandas").DataFrame(self._columns(), index=self.time.cpu().numpy())
        frame.index.name = "t"
        frame.attrs["units"] = {"t": "s"} | self._units()
        return self._in_own_units(frame) if own_units else frame

    @in_its_units
    def _in_own_units(self, frame: Any) -> Any:
        shown = {name: in_display_unit(name, unit, 1.0) for name, unit in self._units().items()}
        for name, (_, factor) in shown.items():
            frame[name] *= factor
        frame.attrs = {}
        names = {name: f"{name} [{unit}]" for name, (unit, _) in shown.items()}
        return frame.rename(columns=names).rename_axis("t [s]")

    def to_xarray(self) -> Any:
        """An xarray.Dataset (extra `xarray`): one variable per channel in SI over `time` in s; masked readings
        are NaN.
        """
        units = self._units()
        variables = {name: ("time", column, {"units": units[name]}) for name, column in self._columns().items()}
        coordinates = {"time": ("time", self.time.cpu().numpy(), {"units": "s"})}
        return needed("xarray").Dataset(variables, coordinates, {"source": self.source})

    def compared(self, predicted: torch.Tensor) -> Any:
        """An xarray.Dataset (extra `xarray`) of measured, predicted and residual outputs over time and sensor, SI.

        predicted (T, N): outputs of a model.
        """
        series = {"measured": self.readings, "predicted": predicted, "residual": self.readings - predicted}
        coordinates = {
            "time": ("time", self.time.cpu().numpy(), {"units": "s"}),
            "sensor": list(self.output_names),
            "unit": ("sensor", list(self.output_units)),
        }
        variables = {name: (("time", "sensor"), values.cpu().numpy()) for name, values in series.items()}
        return needed("xarray").Dataset(variables, coordinates, {"source": self.source})

    def _columns(self) -> dict[str, Any]:
        names = (*self.input_names, *self.output_names)
        return dict(zip(names, torch.cat([self.inputs, self.readings], dim=1).T.cpu().numpy(), strict=True))

    def _units(self) -> dict[str, str]:
        names = (*self.input_names, *self.output_names)
        return dict(zip(names, (*self.input_units, *self.output_units), strict=True))

    @property
    def interval(self) -> float:
        """The usual sampling interval, s: the smallest median interval between the readings of any sensor.

        Rows with readings of other sensors only, or with inputs only, do not count.
        """
        times = [self.time[column] for column in self.mask.T if int(column.sum()) > 1] or [self.time]
        return min(float(torch.median(torch.diff(each))) for each in times) if len(self) > 1 else 0.0

    def to(self, device: torch.device) -> Recording:
        """The recording with its tensors on a device."""
        tensors = {name: getattr(self, name).to(device) for name in ("time", "inputs", "outputs", "mask")}
        return replace(self, **tensors)

    @property
    def origin(self) -> dict[str, str]:
        """What a log says of the recording's file: path, hash, time 0, first time of a part, s, and the unit of each
        channel in the file.
        """
        began = "" if self.began is None else stamp(self.began, self.zone)
        clock = {"began": began} if began else {}
        clock |= {"first": repr(float(self.time[0]))} if len(self) and self.time[0] else {}
        return {"path": self.source, "sha256": self.sha256} | clock | {f"unit.{n}": u for n, u in self.written.items()}

    @property
    def clock_zero(self) -> float | None:
        """Time 0 as the file's clock showed it, s since 1970; None if it has no dates."""
        return None if self.began is None else self.began + self.zone

    def selected(self, inputs: Sequence[str], outputs: Sequence[str]) -> Recording:
        """The recording with these channels only, in this order. Raises ValueError for a missing one."""
        input_columns, output_columns = self.input_columns(inputs), self.output_columns(outputs)
        return replace(
            self,
            inputs=self.inputs[:, input_columns],
            outputs=self.outputs[:, output_columns],
            mask=self.mask[:, output_columns],
            input_names=tuple(inputs),
            output_names=tuple(outputs),
            input_units=tuple(self.input_units[k] for k in input_columns),
            output_units=tuple(self.output_units[k] for k in output_columns),
        )

    def stretch(self, first: int, last: int) -> Recording:
        """Samples first..last-1, on the same clock."""
        part = slice(first, last)
        was_on = (~(self.inputs[:first] <= 0.0)).any(dim=0).tolist()
        return replace(
            self,
            ran=self.ran | {name for name, on in zip(self.input_names, was_on, strict=True) if on},
            time=self.time[part],
            inputs=self.inputs[part],
            outputs=self.outputs[part],
            mask=self.mask[part],
        )

    def window(self, start: float = -math.inf, stop: float = math.inf) -> Recording:
        """Samples with start <= time <= stop (s), on the same clock. Raises ValueError for fewer than two."""
        first = int((self.time < start).sum())
        last = int((self.time <= stop).sum())
        if last - first < 2:
            limits = [
                f"{word} {t:g} s" for word, t in (("after start", start), ("before stop", stop)) if math.isfinite(t)
            ]
            raise ValueError(
                f"{self.source}: expected at least two samples {' and '.join(limits)}, got {max(last - first, 0)} (the "
                f"recording runs from {self.time[0]:g} s to {self.time[-1]:g} s)"
            )
        return self.stretch(first, last)

    def masked(self, intervals: Iterable[tuple[float, float]]) -> Recording:
        """The recording with readings in start <= time <= stop (s) masked; inputs are unchanged."""
        keep = torch.ones_like(self.time, dtype=torch.bool)
        for start, stop in intervals:
            if not start < stop:
                raise ValueError(f"{self.source}: expected masks with start < stop, got [{start:g}, {stop:g}] s")
            keep &= (self.time < start) | (self.time > stop)
        return replace(self, mask=self.mask & keep[:, None])

    def every(self, step: int) -> Recording:
        """Every step-th sample. An input becomes its mean until the next kept sample, held, which preserves the volume.

        A mean over any unknown input (NaN) is unknown.
        """
        if step < 1:
            raise ValueError(f"{self.source}: expected every to be a whole number from 1, got {step}")
        if step == 1:
            return self
        if step >= len(self):
            raise ValueError(f"{self.source}: expected every below its {len(self)} samples, got {step}; lower it")
        return replace(
            self,
            time=self.time[::step],
            inputs=self._means(step),
            outputs=self.outputs[::step],
            mask=self.mask[::step],
            hold="zero_order",
        )

    def _means(self, step: int) -> torch.Tensor:
        """Mean inputs (T/step, M) over blocks of `step` samples, weighted by the time from each sample to the next."""
        steps, inputs = torch.diff(self.time), self.inputs
        if self.hold == "linear":
            inputs = torch.cat((0.5 * (inputs[1:] + inputs[:-1]), inputs[-1:]))
        lasting = torch.cat((steps, steps[-1:]))[:, None]
        block = torch.arange(len(self.time), device=self.time.device) // step
        first = inputs[::step]
        volume = torch.zeros_like(first).index_add_(0, block, (inputs - first[block]) * lasting)
        return first + volume / lasting.new_zeros(len(first), 1).index_add_(0, block, lasting)

    def known_segments(self) -> list[Recording]:
        """The longest segments in which all inputs are known."""
        return [self.stretch(*run) for run in runs_of(torch.isfinite(self.inputs).all(dim=1))]


def runs_of(flags: torch.Tensor) -> list[tuple[int, int]]:
    """The first index of each run of True, and the first one after it."""
    padded = flags.to(torch.int8)
    edges = torch.diff(padded, prepend=padded.new_zeros(1), append=padded.new_zeros(1)).nonzero().flatten().tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _range(values: torch.Tensor) -> tuple[float, float]:
    finite = values[torch.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (math.nan, math.nan)
