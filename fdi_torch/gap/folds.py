"""Cross-validation within the recording: what a fit predicts of stretches that it has not seen.

Stretches take turns in a few folds, so that every event lies in several of them. Without fold f, whose whitened
residuals are r_f with slopes J_f, a fit with curvature H ends one Gauss-Newton step away, and there leaves

    r_f + J_f (H - J_f' J_f)^-1 J_f' r_f

(Allen, 1974, "The relationship between variable selection and data augmentation", for blocks): no fit is repeated.
"""

from __future__ import annotations

import torch

from fdi_torch.gap.fitting import Fit, Fitter

FOLDS, STRETCHES = 5, 8  # and how many stretches make up each fold


def held_out_cost(fitter: Fitter, fit: Fit) -> float:
    """Chi-square of all folds, each predicted from the others."""
    residual, jacobian = fitter.white(fit.near)
    low, high, scale = fitter.box(fit.space)
    r, j = residual[0], jacobian[0] * scale
    # What no other fold shows is known to its range.
    width = torch.nan_to_num(high - low, posinf=0.0)
    range_pull = torch.where(width > 0, scale / width.clamp(min=1e-300), 0.0)
    tolerance_pull = torch.nan_to_num(scale / fit.space.std(fit.theta), posinf=0.0)
    whole = torch.einsum("scp,scq->pq", j, j) + torch.diag(tolerance_pull**2 + range_pull**2)
    turn = torch.arange(len(r)) * FOLDS * STRETCHES // len(r) % FOLDS
    total = 0.0
    for fold in range(FOLDS):
        mine = turn == fold
        own, left = j[mine].flatten(0, 1), r[mine].flatten()
        rest = whole - own.T @ own + 1e-9 * torch.diag(torch.diagonal(whole))
        moved = torch.linalg.lstsq(rest, (own.T @ left).unsqueeze(-1)).solution.squeeze(-1)
        inside = torch.minimum(torch.maximum(fit.theta - moved * scale, low), high)
        predicted = left + own @ ((fit.theta - inside) / scale)
        total += float(predicted @ predicted)
    return total
