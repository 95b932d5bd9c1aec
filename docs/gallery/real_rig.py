"""A real rig: the monitor finds a leak that was opened at 61 s in three coupled tanks, from pressures and pump duty."""

import os
import sys
import tempfile
from pathlib import Path

import yaml
from style import BLUE, GREY, INK, ORANGE, figure, save

import fdi_torch

ROOT = Path(__file__).resolve().parents[2]
data = Path(os.environ.get("FDI_TORCH_DATA", ROOT.parent / "shared" / "data"))
if not (data / "three_tank_leak").is_dir():
    print("skipped: the recordings of real rigs are not here; set FDI_TORCH_DATA to their folder")
    sys.exit()
os.environ["FDI_TORCH_DATA"] = str(data)

job = yaml.safe_load((ROOT / "configs/monitor/three_tank_leak.yaml").read_text(encoding="utf-8"))
plant = fdi_torch.load_plant("three_tank_leak")
with tempfile.TemporaryDirectory() as folder:
    done = fdi_torch.monitor(job | {"output": {"folder": folder}})
for event in done.events:
    print(event.line)
recording = fdi_torch.read_recording(data / job["recording"]["file"], plant)

drawn, axes = figure(1, 1, done.headline)
axis = axes[0, 0]
for k, color in enumerate((BLUE, ORANGE, GREY)):
    axis.plot(recording.time, recording.outputs[:, k], color=color, label=recording.output_names[k])
axis.axvspan(*(float(end.split()[0]) for end in job["fault_free"]), color="#eef2f6", zorder=0)
axis.text(1, 0.93, "fault-free part: the monitor learns", transform=axis.get_xaxis_transform(), fontsize=9)
axis.text(60, 0.05, "leak opened at 61 s", transform=axis.get_xaxis_transform(), color=ORANGE, ha="right", fontsize=9)
axis.axvline(61, color=ORANGE, linestyle="--")
for event, height in zip([e for e in done.events if e.kind in ("alarm", "isolated")], (0.3, 0.2), strict=False):
    axis.axvline(event.time, color=INK, linewidth=0.8)
    words = {"xycoords": axis.get_xaxis_transform(), "fontsize": 9}
    axis.annotate(f"{event.kind} at {event.time:g} s", (event.time + 1, height), **words)
axis.set(xlabel="time, s", ylabel="pressure, V")
axis.legend(frameon=False, loc="center right")
save(drawn, __file__)
