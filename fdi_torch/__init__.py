"""Fault diagnosis and sim-to-real gap diagnosis of liquid-tank plants by differentiable simulation."""
