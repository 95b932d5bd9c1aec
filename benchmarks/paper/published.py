"""Numbers published in the paper, and the order of its five parameters."""

from __future__ import annotations

PARAMETERS = ("T1.leak.size", "OUT2.net_outlet.size", "T3.leak.size", "P13.openness.size", "P32.openness.size")
"""Names of theta_1 to theta_5 in this package."""

SYMBOLS = ("θ₁", "θ₂", "θ₃", "θ₄", "θ₅")

TABLE_2: dict[str, tuple[float | None, ...]] = {
    "table2_1d": (0.099672, 0.99895, 0.002993, 0.988149, 0.997931),
    "table2_2d": (0.090868, 0.601092, 0.007281, 0.978094, 0.999205),
    "table2_3d": (0.098079, 0.598053, None, 0.994553, 0.996132),
    "table2_4d": (0.11311, 0.598932, 0.483429, 0.742294, 0.996307),
    "table2_5d": (0.096488, 0.606524, 0.513945, 0.689603, 0.912194),
}
"""Noise-free estimates by run file. None: a misprint, the entry of theta_2 is repeated."""

TABLE_3: dict[str, tuple[float | None, ...]] = {
    "table3_snr50": (0.300550, 0.301163, 0.491633, 0.602957, 0.996162),
    "table3_snr40": (0.298721, 0.259900, 0.494183, 0.603952, 0.991430),
    "table3_snr30": (0.290431, 0.295185, 0.495723, 0.594899, 0.998303),
    "table3_snr20": (0.307865, 0.274000, 0.493756, 0.595272, 0.998101),
    "table3_snr10": (0.275272, 0.303014, 0.428642, 0.616803, 0.995124),
}
"""Estimates of one fault by run file, SNR 50 to 10 dB."""
