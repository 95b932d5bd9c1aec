"""Autograd through the plant: torch minimises the misfit of two faults, and the path crosses the valley of the cost."""

import torch
from style import BLUE, INK, ORANGE, figure, save

import fdi_torch

names = ["T1.leak.size", "P13.plugging.size"]
truth = {"T1.leak": 0.15, "P13.plugging": 0.3}
steps = {"steps": [["0 s", "50 cm^3/s"], ["200 s", "70 cm^3/s"], ["400 s", "40 cm^3/s"]]}
noise = {"std": {"h1": "1 mm", "h2": "1 mm", "h3": "1 mm"}}
recording = fdi_torch.simulate(inputs={"Q1": steps, "Q2": "50 cm^3/s"}, duration="600 s", noise=noise, faults=truth)
fitting = fdi_torch.set_up("three_tank", [recording], names, start="equilibrium")
engine = fitting.engines(step=1.0)[0]


def rmse(theta: torch.Tensor) -> torch.Tensor:
    """Root-mean-square error of the readings in mm; theta (*batch, 2)."""
    return 1e3 * (engine.readings(theta) - recording.outputs).square().mean(dim=(-2, -1)).sqrt()


theta = torch.zeros(2, dtype=torch.float64, requires_grad=True)
optimiser = torch.optim.Adam([theta], lr=0.02)
path = [theta.detach().clone()]
for _ in range(120):
    optimiser.zero_grad()
    rmse(theta).backward()
    optimiser.step()
    path.append(theta.detach().clone())
ends = torch.stack(path)
print("estimate", ends[-1].tolist(), "truth", list(truth.values()), "rmse", float(rmse(ends[-1])), "mm")

sizes = torch.linspace(-0.05, 0.45, 60, dtype=torch.float64)
grid = torch.stack(torch.meshgrid(sizes, sizes, indexing="ij"), dim=-1)
cost = rmse(grid.flatten(0, 1)).view(60, 60)  # 3600 simulations in one batch

drawn, axes = figure(1, 2, "Gradients of a simulation: 120 steps of torch.optim.Adam")
contours, course = axes[0]
lines = contours.contour(sizes, sizes, cost.T, levels=[1.5, 3, 6, 12, 24, 48, 96], colors=INK, linewidths=0.7)
contours.clabel(lines, fmt="%g mm", fontsize=8)
contours.plot(ends[:, 0], ends[:, 1], ".-", color=BLUE, markersize=4, label="path of the optimiser")
contours.plot(*truth.values(), "x", color=ORANGE, markersize=10, markeredgewidth=2, label="simulated faults")
contours.set(xlabel="size of the leak in T1", ylabel="plugging of P13")
contours.legend(frameon=True, loc="lower right")
course.semilogy(rmse(ends), color=BLUE)
course.axhline(1.0, color=ORANGE, linestyle="--")
course.text(5, 1.08, "noise of the sensors", color=ORANGE)
course.set(xlabel="step", ylabel="error of the readings, mm")
save(drawn, __file__)
