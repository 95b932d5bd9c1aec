"""The gap diagnosis: why a plant file does not explain a recording, and which effects close the gap.

`diagnose.py` shows the stages. `preprocess/` checks recordings, `localization/` ranks places without the library of
effects, `free_runs/` predicts recordings from their first samples and refits a plant.
"""
