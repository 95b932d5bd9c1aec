"""A lag that the model lacked: found in one recording, tested on another."""

import tempfile

from style import BLUE, GREEN, ORANGE, figure, save

import fdi_torch

noise = {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}}
runs = []
for seed, times in enumerate((("150 s", "300 s", "420 s"), ("100 s", "250 s", "500 s"))):
    steps = {"steps": [["0 s", "40 cm^3/s"], *([t, f"{q} cm^3/s"] for t, q in zip(times, (70, 30, 60), strict=True))]}
    inputs = {"Q1": steps, "Q2": "45 cm^3/s"}
    faults = {"Q1.pump_lag": "10 s"}
    runs.append(fdi_torch.simulate(inputs=inputs, duration="600 s", noise=noise, faults=faults, seed=seed))

plant = fdi_torch.load_plant("three_tank")
with tempfile.TemporaryDirectory() as folder:
    found = fdi_torch.gap(plant, runs[0], runs[1], out=folder)
print(found)

closure = found.answer.closure
drawn, axes = figure(1, 2, found.headline, width_ratios=(3, 2))
residual, bars = axes[0]
for model, color, label in ((plant, ORANGE, "nominal"), (found.adopted(), BLUE, "with the lag")):
    free = fdi_torch.predict(model, runs[1]).prediction
    error = 1e3 * (runs[1].outputs - free.readings)
    residual.plot(runs[1].time, error[:, 0], color=color, linewidth=0.9, label=label)
residual.set(xlabel="time, s", ylabel="error of h1 in a free run, mm")
residual.legend(frameon=False)
rows = {"nominal": ORANGE, "recalibrated": ORANGE, "augmented": BLUE, "noise_floor": GREEN}
bars.barh(["nominal", "recalibrated", "with the lag", "noise"], [10 * closure[k] for k in rows], color=rows.values())
bars.invert_yaxis()
bars.set_xlabel("error of free runs on the other recording, mm")
save(drawn, __file__)
