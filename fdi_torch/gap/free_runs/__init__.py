"""Free runs of a plant file: prediction, initial state, refit, and variance between recordings."""
