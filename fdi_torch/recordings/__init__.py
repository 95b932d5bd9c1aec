"""Recordings out of files (CSV, MCAP logs, files that still grow), and what is odd about one before it is fitted."""
