"""The methods that write each topic of a log, from plain numbers, arrays and tensors of any library.

`t` is plant time in s. An event without plant time (a generation, an iteration, a trial) counts one second per step, so
that viewers draw it over its number; other events default to the latest logged time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, count, repeat
from typing import Any

import numpy as np
import orjson

from fdi_torch.interruption import SteadyLock
from fdi_torch.logbook.payload import NON_FINITE, WALL, as_array, as_it_is, pack, plain
from fdi_torch.logbook.schemas import Register
from fdi_torch.logbook.sink import EPOCH_NS, Timed, log_time_of
from fdi_torch.logbook.topic_definitions import Channel

Named = Mapping[str, Any]
_RESERVED = ("t", NON_FINITE, WALL, "masked")
_NORMAL_95 = 1.96  # half width of the central 95 % of a normal distribution, standard deviations
_BLOCK = 4096


class Topics:
    """Encodes messages, each on a channel that describes its fields, and passes them to `put`. One method per topic."""

    def __init__(self) -> None:
        self._lock = SteadyLock()
        self._latest = 0.0
        self.register = Register()

    def put(self, messages: Iterable[Timed]) -> None:
        raise NotImplementedError

    def write(
        self, topic: str, fields: Named, t: float | None = None, *, units: Mapping[str, str] | None = None
    ) -> None:
        """Write one message. units: of named numbers.

        A field with the value None is omitted. Raises ValueError for a non-finite time and for reserved names.
        """
        if "t" in fields:
            raise ValueError(f"{topic}: expected the time as argument, got it among the fields; remove it there")
        t = self._latest if t is None else float(t)
        if not math.isfinite(t):
            raise ValueError(f"{topic}: expected a finite time, got {t}; give the plant's time in s")
        with self._lock:
            message: Named = {"t": t, **fields}
            data = as_it_is(message)
            if data is None:
                message = plain(message)
                data = orjson.dumps(message)
            self._latest = max(self._latest, t)
            channel, log_time = self.register.channel(topic, fields, message, units), log_time_of(t)
            self.put([(channel, log_time, log_time, self.register.take_numbers(topic), data)])

    def samples(self, topic: str, time: Any, values: Any, names: Sequence[str], units: Sequence[str]) -> None:
        """Write a whole signal, values (T, N) over time (T,), one message per sample."""
        self.recording_blocks([(topic, as_array(values), names, units, None, None)], as_array(time))

    def recording(
        self,
        time: Any,
        inputs: Any,
        outputs: Any,
        input_names: Sequence[str],
        output_names: Sequence[str],
        input_units: Sequence[str],
        output_units: Sequence[str],
        *,
        mask: Any = None,
        hold: str = "zero_order",
        group: str = "",
    ) -> None:
        """Write a recording to `/plant/input` and `/plant/output`, or `/plant/GROUP/...` if a log has several.

        time (T,) s, inputs (T, M), outputs (T, N), mask (T, N): True for valid readings. NaN is preserved.
        """
        root = f"/plant/{group}" if group else "/plant"
        mask = None if mask is None else as_array(mask).astype(bool)
        source = (f"{root}/input", as_array(inputs), input_names, input_units, None, {"hold": hold})
        readings = (f"{root}/output", as_array(outputs), output_names, output_units, mask, None)
        self.recording_blocks([source, readings], as_array(time))

    def predictions(
        self,
        time: Any,
        outputs: Any,
        predicted: Any,
        names: Sequence[str],
        units: Sequence[str],
        *,
        mask: Any = None,
        noise_std: Any = None,
        group: str = "",
    ) -> None:
        """Write the model's readings and the residuals to `/estimate/output` and `/estimate/residual`.

        time (T,) s, outputs and predicted (T, N), mask (T, N): True for valid readings; other residuals are NaN.
        noise_std (N,): noise level of each sensor, whose 95 % band (1.96 standard deviations) is written beside it.
        group: as for `recording`.
        """
        root = f"/estimate/{group}" if group else "/estimate"
        model, readings = as_array(predicted).astype(np.float64), as_array(outputs).astype(np.float64)
        valid = np.isfinite(readings) if mask is None else as_array(mask).astype(bool)
        residual, columns, shown = np.where(valid, readings - model, np.nan), list(names), list(units)
        if noise_std is not None:
            band = np.broadcast_to(_NORMAL_95 * as_array(noise_std), residual.shape)
            residual = np.concatenate([residual, -band, band], axis=1)
            columns += [f"{name}_{side}" for side in ("low", "high") for name in names]
            shown += [*units, *units]
        fitted = (f"{root}/output", model, names, units, None, None)
        self.recording_blocks([fitted, (f"{root}/residual", residual, columns, shown, None, None)], as_array(time))

    def recording_blocks(self, signals: Sequence[tuple[Any, ...]], time: np.ndarray) -> None:
        """Write several signals with one clock, sample by sample, in blocks that limit memory."""
        for topic, values, names, *_ in signals:
            _check_signal(topic, values, names, len(time))
        if not np.isfinite(time).all():
            raise ValueError(f"{signals[0][0]}: expected finite times, got NaN or infinity; drop those samples")
        for first in range(0, len(time), _BLOCK):
            block = slice(first, first + _BLOCK)
            clock = time[block].astype(np.float64)
            log_times = (EPOCH_NS + np.rint(clock * 1e9).astype(np.int64)).tolist()
            streams = []
            for topic, values, names, units, mask, about in signals:
                numbers = dict.fromkeys(names, 0.0)
                channel = self.register.channel(topic, numbers, numbers, dict(zip(names, units, strict=True)), about)
                valid = None if mask is None else mask[block]
                payloads = _payloads(names, clock, values[block].astype(np.float64), valid)
                sequence = count(self.register.take_numbers(topic, len(clock)))
                streams.append(zip(repeat(channel), log_times, log_times, sequence, payloads, strict=False))
            self.put(chain.from_iterable(zip(*streams, strict=True)))
        self._latest = max(self._latest, float(time.max())) if len(time) else self._latest

    def follow_on(self, channel: Channel, sequence: int, t: float) -> None:
        """Continue numbering and description as if the message (channel, sequence, t) had just been written."""
        self.register.follow_on(channel, sequence)
        self._latest = max(self._latest, t)

    def alarm(self, t: float, event: str, channel: str, message: str = "", **numbers: Any) -> None:
        """An event of the detection; numbers: value, threshold, onset (s) and others by name."""
        fields = {"event": event, "channel": channel, "message": message, **numbers}
        self.write("/observer/alarm", fields, t)

    def population(self, generation: int, arrays: Mapping[str, Any]) -> None:
        """The state of the search for its continuation: any numeric arrays, such as population and cost."""
        fields: dict[str, Any] = {"problem": 0, "generation": generation}
        for name, array in arrays.items():
            fields |= pack(name, array)
        self.write("/estimator/de/population", fields, generation)

    def estimate(
        self,
        names: Sequence[str],
        values: Any,
        std: Any,
        covariance: Any,
        status: str,
        *,
        units: Sequence[str] = (),
        at_bound: Sequence[str] = (),
        unidentifiable: Sequence[str] = (),
        **numbers: Any,
    ) -> None:
        """The final estimate: values (P,), std (P,), covariance (P, P); numbers: goodness of fit and others by name."""
        fields = {
            "problem": 0,
            "names": names,
            "units": units,
            "values": values,
            "std": std,
            "covariance": covariance,
            "covariance_shape": list(as_array(covariance).shape),
            "status": status,
            "reason": "",
            "at_bound": at_bound,
            "unidentifiable": unidentifiable,
            **numbers,
        }
        self.write("/estimate/final", fields)

    def fault(
        self, fault: str, location: str, present: bool, *, t: float | None = None, message: str = "", **numbers: Any
    ) -> None:
        """A finding of the diagnosis; numbers: confidence, size, size_std, unit (text), flow, hole_diameter, others."""
        fields = {"fault": fault, "location": location, "present": present, "message": message, **numbers}
        self.write("/diagnosis/fault", fields, t)

    def gap_where(self, location: str, share: float, **numbers: Any) -> None:
        """The probability that something is wrong at a component; in format 1, the share of the gap it explains."""
        self.write("/gap/where", {"location": location, "share": share, **numbers})

    def gap_verdict(self, answer: Named) -> None:
        """The diagnosis of a gap in the format `fdi_torch.gap/2`; numbers of its closure are fields of their own."""
        closure = {k: v for k, v in answer.get("closure", {}).items() if isinstance(v, int | float)}
        where, posterior = answer.get("where", []), answer.get("posterior", [])
        fields = {
            "verdict": answer["verdict"],
            "p_value": answer.get("alarm", {}).get("p_value"),
            "locations": [place["location"] for place in where],
            "shares": [float(place["share"]) for place in where],
            "causes": [_cause(cause) for cause in answer.get("causes", [])],
            "ambiguity_set": [_explanation(causes) for causes in answer.get("ambiguity_set", [])],
            "explanations": [_explanation(item["causes"]) for item in posterior],
            "probabilities": [float(item["probability"]) for item in posterior],
            "unexamined": answer.get("unexamined"),
            "certain": [_cause(cause) for cause in answer.get("certain", [])],
            "answer": orjson.dumps(dict(answer), option=orjson.OPT_SERIALIZE_NUMPY).decode(),
            **closure,
        }
        self.write("/gap/verdict", fields)

    def trial(
        self, trial: int, numbers: Named, *, group: str = "", seed: int | str = "", status: str = "", **texts: str
    ) -> None:
        """One trial of a study."""
        fields = {"trial": trial, "group": group, "seed": str(seed), "status": status, **texts, **numbers}
        self.write("/study/trial", fields, trial)

    def summary(self, group: str, trials: int, numbers: Named, **texts: str) -> None:
        """The summary of one setting of a study."""
        self.write("/study/summary", {"group": group, "trials": trials, **texts, **numbers})

    def say(self, message: str) -> None:
        """One sentence on `/log`."""
        sec, nsec = divmod(log_time_of(self._latest), 10**9)
        fields = {"timestamp": {"sec": sec, "nsec": nsec}, "level": _INFO, "message": message, "name": "fdi"}
        self.write("/log", {**fields, "file": "", "line": 0})


def _payloads(names: Sequence[str], clock: np.ndarray, values: np.ndarray, valid: np.ndarray | None) -> list[bytes]:
    """Payloads of samples (B, N) at the times (B,); those that are finite but not valid (B, N) are masked."""
    rows = [dict(zip(("t", *names), row, strict=True)) for row in zip(clock.tolist(), *values.T.tolist(), strict=True)]
    finite = np.isfinite(values)
    masked = np.zeros_like(finite) if valid is None else finite & ~valid
    if finite.all() and not masked.any():
        return [orjson.dumps(row) for row in rows]
    hidden = ([name for name, is_masked in zip(names, row, strict=True) if is_masked] for row in masked.tolist())
    return [orjson.dumps(plain({**row, "masked": of_row or None})) for row, of_row in zip(rows, hidden, strict=True)]


def _check_signal(topic: str, values: np.ndarray, names: Sequence[str], samples: int) -> None:
    if values.shape != (samples, len(names)):
        raise ValueError(f"{topic}: expected values of shape {(samples, len(names))}, got {values.shape}")
    for name in names:
        if name in _RESERVED:
            raise ValueError(f"{topic}: expected a name other than {', '.join(_RESERVED)}, got {name}; rename it")


_INFO = 2  # of the levels debug (1) to fatal (5) of foxglove.Log


def _cause(cause: Named) -> str:
    return f"{cause['effect']}@{cause['location']}"


def _explanation(causes: Sequence[Named]) -> str:
    return " + ".join(_cause(cause) for cause in causes) or "no gap"
