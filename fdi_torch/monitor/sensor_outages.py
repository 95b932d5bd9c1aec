"""Outages of sensors: which of them deliver no readings any more, and what the monitor tells about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from fdi_torch.monitor.samples import ABSENT, Samples


@dataclass(frozen=True)
class SensorOutages:
    """Which sensors are read, after the samples until now.

    names: of the sensors. unread: samples since the last reading of each. last: its time, s; None before the first
    one. longest: most samples in a row without a reading while the noise was learnt. silent: whether an outage was told
    and lasts.
    """

    names: tuple[str, ...]
    unread: tuple[int, ...]
    last: tuple[float | None, ...]
    longest: tuple[int, ...]
    silent: tuple[bool, ...]

    @classmethod
    def at_start(cls, names: Sequence[str]) -> SensorOutages:
        count = len(names)
        return cls(tuple(names), (0,) * count, (None,) * count, (0,) * count, (False,) * count)

    def along(self, samples: Samples, learning_until: float) -> tuple[SensorOutages, list[tuple[int, str]]]:
        """The outages after further samples, and (index of the sample, text) of those that begin or end.

        A sensor is silent after more than ABSENT samples without a reading, and more than twice as many as there were
        in a row until `learning_until` s: a sensor may be read more rarely than others.
        """
        read = torch.isfinite(samples.readings)
        if bool(read.all()) and not any(self.silent) and len(samples):
            count, time = len(self.names), float(samples.time[-1])
            return replace(self, unread=(0,) * count, last=(time,) * count), []
        now, notices = self, []
        for k, (time, row) in enumerate(zip(samples.time.tolist(), read.tolist(), strict=True)):
            now, texts = now._after(time, row, time <= learning_until)
            notices += [(k, text) for text in texts]
        return now, notices

    def _after(self, time: float, read: Sequence[bool], learning: bool) -> tuple[SensorOutages, list[str]]:
        unread = tuple(0 if r else n + 1 for r, n in zip(read, self.unread, strict=True))
        last = tuple(time if r else before for r, before in zip(read, self.last, strict=True))
        longest = tuple(map(max, self.longest, unread)) if learning else self.longest
        late = (n > max(ABSENT, 2 * most) for n, most in zip(unread, longest, strict=True))
        silent = tuple((before or now) and not r for before, now, r in zip(self.silent, late, read, strict=True))
        watched = [name for name, gone in zip(self.names, silent, strict=True) if not gone]
        texts = []
        for name, before, gone, since in zip(self.names, self.silent, silent, self.last, strict=True):
            if gone and not before:
                texts.append(_outage_text(name, since, watched))
            elif before and not gone:
                gap = "" if since is None else f" after {time - since:g} s without a reading"
                texts.append(f"{name} is read again{gap}: the monitor tests its readings again")
        return SensorOutages(self.names, unread, last, longest, silent), texts


def _outage_text(name: str, since: float | None, watched: Sequence[str]) -> str:
    text = f"no reading of {name} " + (f"in {ABSENT} samples" if since is None else f"since {since:g} s")
    if not watched:
        return f"{text}: no sensor is read, and until one is, the monitor notices no fault"
    return (
        f"{text}: until it is read again, the monitor watches the plant by {', '.join(watched)} alone and does not "
        f"notice a fault that only {name} shows"
    )
