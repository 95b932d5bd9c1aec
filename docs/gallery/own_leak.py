"""A leak found in a recording of your own: a CSV file, a plant, one call."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from style import BLUE, GREY, ORANGE, figure, save

import fdi_torch
from fdi_torch import Pipe, PlacedEffect, Plant, Pump, Sensor, Tank

rig = Plant(
    tanks=[Tank("A", area="200 cm^2", height="60 cm"), Tank("B", area="200 cm^2", height="60 cm")],
    pipes=[
        Pipe("link", "A", "B", area="0.6 cm^2", discharge_coefficient=0.6),
        Pipe("drain", "B", "outside", area="0.5 cm^2", discharge_coefficient=0.6),
    ],
    pumps=[Pump("Q", "A", max_flow="6 l/min")],
    sensors=[Sensor("hA", "A"), Sensor("hB", "B")],
    tolerances={"*.discharge_coefficient": "3 %"},
    name="bench",
)
steps = {"steps": [["0 s", "3 l/min"], ["200 s", "4 l/min"], ["400 s", "2 l/min"]]}
noise = {"std": {"hA": "1 mm", "hB": "1 mm"}}
made = fdi_torch.simulate(rig, inputs={"Q": steps}, duration="600 s", noise=noise, faults={"A.leak": 0.2}, seed=1)

with tempfile.TemporaryDirectory() as folder:
    table = np.column_stack([made.time, 6e4 * made.inputs, 100 * made.outputs])  # l/min, cm
    np.savetxt(Path(folder) / "run.csv", table, delimiter=",", header="t_s,Q_l_min,hA_cm,hB_cm", comments="")
    recording = fdi_torch.read_recording(f"{folder}/run.csv", rig)
    suspects = {"parameters": ["A.leak", "B.leak", "link.plugging"]}
    job = {"plant": rig, "recordings": [recording], "estimate": suspects, "output": {"folder": folder}}
    done = fdi_torch.train(job)
print(done)

size = float(done.result.estimate.value[done.fitting.space.names.index("A.leak.size")])
leaking = replace(rig, effects=(PlacedEffect("leak", "A", {"size": size}),))
drawn, axes = figure(1, 2, f"{done.headline}, simulated: 0.2")
for k, axis in enumerate(axes[0]):
    axis.plot(recording.time, 100 * recording.outputs[:, k], ".", color=GREY, markersize=2, label="recording")
    for plant, color, label in ((rig, ORANGE, "without leak"), (leaking, BLUE, "with the leak")):
        levels = fdi_torch.predict(plant, recording).prediction.readings
        axis.plot(recording.time, 100 * levels[:, k], color=color, label=label)
    axis.set(xlabel="time, s", ylabel=f"level of {rig.sensors[k].tank}, cm")
axes[0, 0].legend(frameon=False)
save(drawn, __file__)
