"""A noise study: the error of the estimate against the Cramer-Rao bound, at four noise levels."""

import tempfile

from style import BLUE, INK, ORANGE, figure, save

import fdi_torch

steps = {"steps": [["0 s", "36 cm^3/s"], ["200 s", "45 cm^3/s"], ["400 s", "27 cm^3/s"]]}
simulated = {"inputs": {"Q1": steps, "Q2": steps}, "duration": "600 s", "faults": {"T1.leak": 0.2}}
with tempfile.TemporaryDirectory() as folder:
    job = {
        "plant": "three_tank",
        "simulate": simulated | {"noise": {"snr_db": 30}},
        "estimate": {"parameters": ["T1.leak", "P13.plugging"]},
        "study": {"faults": "simulated", "snr_db": [50, 40, 30, 20], "trials": 100},
        "output": {"folder": folder},
    }
    result = fdi_torch.study(job)
print(result)

table = result.table().columns
rows = [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]
drawn, axes = figure(
    1, 2, "100 trials per noise level: the estimate reaches the Cramér-Rao bound, the correlation does not"
)
marks = {"free": ("o", BLUE, "likelihood"), "correlation": ("s", ORANGE, "correlation")}
for axis, name in zip(axes[0], ("T1.leak.size", "P13.plugging.size"), strict=True):
    for estimator, (mark, color, label) in marks.items():
        own = [row for row in rows if row["parameter"] == name and row["estimator"] == estimator]
        snr = [float(row["setting"].split()[1]) for row in own]
        axis.semilogy(snr, [row["RMSE"] for row in own], mark, color=color, label=label)
        if estimator == "free":
            axis.semilogy(snr, [row["RMSE"] / row["RMSE / bound"] for row in own], color=INK, label="Cramér-Rao bound")
    axis.set(xlabel="signal-to-noise ratio, dB", ylabel="root-mean-square error", title=name.removesuffix(".size"))
axes[0, 0].legend(frameon=False)
save(drawn, __file__)
