"""Recordings from files (CSV and other tables, MCAP logs, files that still grow), and checks of a recording before a
fit.
"""
