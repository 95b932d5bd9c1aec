"""Figures, and the report page of a run. The only package that imports matplotlib.

A page is made from a log alone: each section draws its part of the log and is left out if the log has none, so that one
frame serves every kind of run. `predictions` lists the optional arrays.
"""
