"""A monitor along a drain: the pumps stop, the tanks run down, and a leak opens on the way."""

import tempfile

from style import BLUE, GREY, INK, ORANGE, figure, save

import fdi_torch

noise = {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}}
inputs = {"Q1": {"steps": [["0 s", "50 cm^3/s"], ["300 s", "65 cm^3/s"], ["600 s", "0 cm^3/s"]]}}
inputs["Q2"] = {"steps": [["0 s", "50 cm^3/s"], ["400 s", "35 cm^3/s"], ["600 s", "0 cm^3/s"]]}
faults = {"T3.leak": 0.03, "T3.leak.onset": "750 s"}
recording = fdi_torch.simulate(inputs=inputs, duration="1100 s", noise=noise, faults=faults, seed=2)

with tempfile.TemporaryDirectory() as folder:
    job = {"plant": "three_tank", "recording": recording, "fault_free": ["0 s", "600 s"], "output": {"folder": folder}}
    done = fdi_torch.monitor(job)
for event in done.events:
    print(event.line)

drawn, axes = figure(2, 1, done.headline, height=5.4, sharex=True, height_ratios=(3, 2))
levels, sizes = axes[:, 0]
for k, name in enumerate(recording.output_names):
    levels.plot(recording.time, 100 * recording.outputs[:, k], color=(BLUE, GREY, ORANGE)[k], label=name)
levels.axvspan(0, 600, color="#eef2f6", zorder=0)
levels.text(10, 3, "fault-free part: the monitor learns", color=INK, fontsize=9)
levels.set(ylim=(-3, 85))
levels.set_ylabel("level, cm")
levels.legend(frameon=False, ncols=3, loc="upper left")
heights = iter((60, 50, 40, 30, 20, 10))
for event in done.events:
    if event.kind in ("alarm", "explained", "isolated"):
        levels.axvline(event.time, color=INK, linewidth=0.8)
        levels.annotate(f"{event.kind} at {event.time:g} s", (event.time + 4, next(heights)), fontsize=9)
    if event.faults == ("T3.leak.size",):
        sizes.errorbar(event.time, event.sizes[0], 1.96 * event.stds[0], fmt="o", color=BLUE, capsize=4)
sizes.axhline(0.03, color=ORANGE, linestyle="--")
sizes.text(10, 0.0302, "simulated size", color=ORANGE, fontsize=9)
sizes.axvline(750, color=ORANGE, linestyle="--")
sizes.text(745, 0.0335, "leak opens", color=ORANGE, ha="right", fontsize=9)
sizes.set(xlabel="time, s", ylabel="size of the leak in T3, 95 %", xlim=(0, 1110))
save(drawn, __file__)
