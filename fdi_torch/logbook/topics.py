"""The methods that write each topic of a log, from plain numbers, arrays and tensors of any library.

`t` is plant time in s. An event without plant time (a generation, an iteration, a trial) counts one second per step, so
that viewers draw it over its number; other events default to the latest logged time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import orjson

from fdi_torch.logbook.messages import Messages, Named
from fdi_torch.logbook.payload import as_array, pack
from fdi_torch.logbook.sink import log_time_of

_INFO = 2  # of the levels debug (1) to fatal (5) of foxglove.Log


class Topics(Messages):
    """One method per topic."""

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


def _cause(cause: Named) -> str:
    return f"{cause['effect']}@{cause['location']}"


def _explanation(causes: Sequence[Named]) -> str:
    return " + ".join(_cause(cause) for cause in causes) or "no gap"
