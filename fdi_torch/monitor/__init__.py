"""Diagnosis on line: observers, detection, isolation, moving windows, and what can be diagnosed at all."""
