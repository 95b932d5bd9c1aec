"""On-line diagnosis: observers, detection, isolation, window monitors, and diagnosability.

`believed` (P,) in this room are the parameter values that the observer uses: nominal values and calibrated constants,
changed by the faults isolated so far. `healthy` are the same values with every fault at nominal.
"""
