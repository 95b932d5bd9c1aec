"""Estimation: global search, refinement, and how sure one may be of the result."""
