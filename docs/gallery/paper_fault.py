"""The fault of Table 3 of the 2020 paper: five parameters of three tanks, at a signal-to-noise ratio of 30 dB."""

import tempfile

import torch
from style import BLUE, GREY, figure, save

import fdi_torch

with tempfile.TemporaryDirectory() as folder:
    run = fdi_torch.load_run(None, [f"output.folder={folder}"])  # the built-in example
    done = fdi_torch.train(run)
print(done)

recording, predicted = done.fitting.recordings[0], done.result.predicted[0]
estimate = done.result.estimate
names = done.fitting.space.names
truth = [done.truth[name] for name in names]

drawn, axes = figure(1, 2, "Five faults at once, estimated from noisy levels", width_ratios=(3, 2))
levels, sizes = axes[0]
for k, name in enumerate(recording.output_names):
    levels.plot(recording.time, 100 * recording.outputs[:, k], ".", color=GREY, markersize=2)
    levels.plot(recording.time, 100 * predicted[:, k], color=BLUE)
    levels.annotate(name, (recording.time[-1], 100 * predicted[-1, k]), xytext=(4, -3), textcoords="offset points")
levels.set(xlabel="time, s", ylabel="level, cm")
error = (estimate.value - torch.tensor(truth)) / estimate.std
sizes.axvspan(-1.96, 1.96, color="#eef2f6", zorder=0)
sizes.plot(error, range(len(names)), "o", color=BLUE)
for row, (value, true) in enumerate(zip(estimate.value.tolist(), truth, strict=True)):
    place = {"xytext": (0, 8), "textcoords": "offset points", "ha": "center"}
    sizes.annotate(f"{value:.3f} (simulated {true:g})", (float(error[row]), row), fontsize=9, **place)
sizes.set_yticks(range(len(names)), [name.removesuffix(".size") for name in names])
sizes.set(
    xlabel="(estimate − simulated) / standard error", xlim=(-3.7, 3.7), ylim=(4.5, -0.7), title="shaded: 95 % interval"
)
save(drawn, __file__)
