"""Draw hero.png: free runs of the nominal and of the diagnosed plant along a recording not used for the diagnosis.

The simulated rig is the shipped three-tank plant with a leak in T1 and laminar flow at low heads in pipe P13. The gap
diagnosis sees one recording of it; the picture shows another one with other inputs. Run it from the repository root:
python docs/pictures/hero.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import fdi_torch

NOISE = {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}}
TRUTH = {"T1.leak": 0.15, "P13.laminar_flow": "5 cm"}
FIRST = {
    "Q1": {"steps": [["0 s", "50 cm^3/s"], ["300 s", "75 cm^3/s"], ["700 s", "35 cm^3/s"]]},
    "Q2": {"steps": [["0 s", "50 cm^3/s"], ["500 s", "25 cm^3/s"], ["900 s", "60 cm^3/s"]]},
}
SECOND = {
    "Q1": {"steps": [["0 s", "40 cm^3/s"], ["400 s", "80 cm^3/s"], ["800 s", "50 cm^3/s"]]},
    "Q2": {"steps": [["0 s", "60 cm^3/s"], ["200 s", "35 cm^3/s"], ["1000 s", "55 cm^3/s"]]},
}
INK, RECORDED, NOMINAL, DIAGNOSED = "#1f2933", "#9aa5b1", "#b84a00", "#0b6cab"


def main() -> None:
    plant = fdi_torch.load_plant("three_tank")
    runs = [
        fdi_torch.simulate(plant, inputs=inputs, duration="1200 s", faults=TRUTH, noise=NOISE, seed=seed)
        for seed, inputs in enumerate((FIRST, SECOND))
    ]
    with tempfile.TemporaryDirectory() as folder:
        result = fdi_torch.gap(plant, runs[0], out=folder)
    print(result.headline)
    recording = runs[1]
    free = {
        "nominal model": (fdi_torch.predict(plant, recording).prediction, NOMINAL),
        "diagnosed model": (fdi_torch.predict(result.adopted(), recording).prediction, DIAGNOSED),
    }
    draw(plant, recording, free, Path(__file__).with_name("hero.png"))


def draw(plant, recording, free, path: Path) -> None:
    """Levels above, errors below; one column per sensor."""
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(2, 3, figsize=(12, 5.4), sharex=True, height_ratios=(3, 2), layout="constrained")
    minutes = recording.time / 60.0
    for k, sensor in enumerate(plant.sensors):
        level, error = axes[:, k]
        level.plot(minutes, 100.0 * recording.outputs[:, k], color=RECORDED, linewidth=4, label="recording")
        for label, (prediction, color) in free.items():
            style = {"color": color, "linewidth": 1.5, "linestyle": "--" if color == NOMINAL else "-"}
            level.plot(minutes, 100.0 * prediction.readings[:, k], label=label, **style)
            residual = 1e3 * (recording.outputs[:, k] - prediction.readings[:, k])
            error.plot(minutes, residual, color=color, linewidth=0.8)
            text = f"{label}: {1e3 * prediction.rmse[sensor.name]:.1f} mm rms"
            below = 0.16 if color == NOMINAL else 0.05
            error.text(0.03, below, text, transform=error.transAxes, color=color, fontsize=9.5)
        error.axhline(0.0, color=INK, linewidth=0.6)
        level.set_title(f"{sensor.name}, level of tank {sensor.tank}", loc="left", fontweight="bold", color=INK)
        error.set_xlabel("time, min")
        for axis in (level, error):
            axis.grid(color="#d3d9e0", linewidth=0.5)
    axes[0, 0].set_ylabel("level, cm")
    axes[1, 0].set_ylabel("recorded − model, mm")
    axes[0, 0].legend(frameon=False, loc="best")
    low = min(axis.get_ylim()[0] for axis in axes[1])
    high = max(axis.get_ylim()[1] for axis in axes[1])
    for axis in axes[1]:
        axis.set_ylim(low - 0.25 * (high - low), high)
    title = "Free runs along a recording that the diagnosis did not use"
    figure.suptitle(title, x=0.01, ha="left", color=INK, fontsize=13)
    figure.savefig(path, dpi=130, facecolor="white")


if __name__ == "__main__":
    main()
