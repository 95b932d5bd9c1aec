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

import numpy as np

from fdi_torch.report.material import Material
from fdi_torch.report.reference_models import has_causes
from fdi_torch.report.style import MARK, MODEL, OTHER, SOFT

# Models of a gap diagnosis: array -> label on the page and colour.
MODELS = {
    "nominal": ("nominal model", SOFT),
    "recalibrated": ("recalibrated", OTHER),
    "augmented": ("with the causes", MODEL),
    "ceiling": ("free-form", MARK),
}


def compared_models(material: Material) -> tuple[str, ...]:
    """The models whose residuals the page compares: without the causes and, if there are any, with them."""
    return ("recalibrated", "augmented") if has_causes(material.answer) else ("recalibrated",)


def predicted(material: Material, k: int) -> np.ndarray | None:
    """Readings of recording k (from 0) that the run predicts, at its estimate or with its cause; None without any."""
    arrays, group, shape = material.arrays, material.groups[k], material.recordings[k].outputs.shape
    alone = ("predicted",) if len(material.groups) == 1 else ()
    for name in (f"predicted_{k + 1}", *alone, f"{group}_augmented" if group else "augmented"):
        values = arrays.get(name)
        if values is not None and values.dtype.kind == "f" and values.shape == shape:
            return values
    return None


def residuals(material: Material, k: int) -> np.ndarray | None:
    """Readings of recording k less their predictions, NaN where masked; None without predictions."""
    model, recording = predicted(material, k), material.recordings[k]
    return None if model is None else np.where(recording.mask, recording.outputs - model, np.nan)


def holdout_prefix(number: int) -> str:
    """Prefix of the arrays of the hold-out with this number (from 0)."""
    return "holdout" if number == 0 else f"holdout_{number + 1}"
