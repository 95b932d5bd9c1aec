"""What a plant predicts of files that it was not fitted to: each left out in turn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from fdi_torch.gap.prediction import predict
from fdi_torch.plant.description import PlantDescription
from fdi_torch.recording import Recording


@dataclass(frozen=True)
class Trial:
    """A free run along one recording (start, stop in s): root mean square errors by sensor (SI) of the plant as it is
    (`as_is`) and as fitted to all files but that one (`refitted`).
    """

    source: str
    start: float
    stop: float
    as_is: Mapping[str, float]
    refitted: Mapping[str, float]


def in_turn(
    plant: PlantDescription,
    recordings: Sequence[Recording],
    trials: Sequence[Recording],
    fit: Callable[[Sequence[Recording]], PlantDescription],
    start_samples: int,
    tell: Callable[[float, str], None] = lambda share, text: None,
    settle: float | None = None,
) -> list[Trial]:
    """trials: what is run freely; for each, `fit` sees the recordings of all other files. Recordings of one file are
    told by the hash of its contents. settle: as `predict` has it, s. Raises ValueError where that would leave none to
    fit.
    """
    refitted: dict[str, PlantDescription] = {}
    found = []
    for k, run in enumerate(trials):
        tell(k / len(trials), run.source)
        if run.sha256 not in refitted:
            rest = [r for r in recordings if r.sha256 != run.sha256]
            if not rest:
                raise ValueError(f"{run.source}: expected recordings of another file to fit to, got none; give more")
            refitted[run.sha256] = fit(rest)
        plants = plant, refitted[run.sha256]
        as_is, without = (predict(p, run, start_samples, settle=settle).rmse for p in plants)
        found.append(Trial(run.source, float(run.time[0]), float(run.time[-1]), as_is, without))
    return found
