"""Localization of a discrepancy without the library of effects.

`regressors.py` and `component_regressors.py` list candidate regressors for the discrepancy of each component.
`discrepancy_regression.py` computes their influence on the readings, `single_regressor_gain.py` a cheap estimate of
what one of them explains, `sparse_regression.py` selects the few that are needed, and `localize.py` ranks the places.
"""
