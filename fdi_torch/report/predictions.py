"""Optional arrays of a log's `results.npz` that the page draws. All SI; sensors in the order of `/plant/output`.

| array | shape | what it is |
|---|---|---|
| `predicted` | (T, N) | readings at the estimate, at the samples of the recording |
| `predicted_K` | (T, N) | the same for the K-th of several recordings, from 1 |
| `nominal`, `recalibrated`, `augmented`, `ceiling` | (T, N) | readings that each model of a gap diagnosis predicts |
| `holdout_time` | (S,) | clock of the hold-out in s |
| `holdout_read` | (S, N) | its readings, NaN where masked |
| `holdout_nominal`, `holdout_recalibrated`, `holdout_augmented`, `holdout_ceiling` | (S, N) | its predictions |
| `holdout_K_...`, `recording_K_...` | (S, N) | the same for the K-th of several hold-outs or recordings, from 2 |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fdi_torch.report.style import MARK, MODEL, OTHER, SOFT

# Models of a gap diagnosis: array -> label on the page and colour.
MODELS = {
    "nominal": ("nominal model", SOFT),
    "recalibrated": ("recalibrated", OTHER),
    "augmented": ("with the cause", MODEL),
    "ceiling": ("free-form", MARK),
}


def predicted(
    arrays: Mapping[str, np.ndarray], number: int, several: bool, shape: Sequence[int], group: str = ""
) -> np.ndarray | None:
    """Predicted readings of the recording with this number (from 0) at the estimate; None if the log has none.

    group: the recording's group in the log of a gap diagnosis.
    """
    of_gap = f"{group}_augmented" if group else "augmented"
    for name in (f"predicted_{number + 1}", *(() if several else ("predicted",)), of_gap):
        values = arrays.get(name)
        if values is not None and values.dtype.kind == "f" and values.shape == tuple(shape):
            return values
    return None


def holdout_prefix(number: int) -> str:
    """Prefix of the arrays of the hold-out with this number (from 0)."""
    return "holdout" if number == 0 else f"holdout_{number + 1}"
