"""Blind benchmark of the gap diagnosis on simulated rigs with other equations and another integrator than the
library's.

`blind_benchmark(cases, seed, out, diagnose)` simulates recordings, seals their causes, runs the diagnosis, opens the
key and scores the answers; `tables` summarises one benchmark or several `joined` ones. Nothing here imports the
library's effects, network or engines.
"""
