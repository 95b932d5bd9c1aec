"""A monitor tried out on simulated runs: how soon, how surely and how exactly it would find what it looks for."""
