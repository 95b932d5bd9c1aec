"""Figures, and the page that shows a run. The only importer of matplotlib.

A page is made from a log alone: each section draws what the log holds and is left out where it holds nothing of it, so
one frame serves every kind of run. `predictions` and `sections/gap` say which optional arrays are drawn.
"""
