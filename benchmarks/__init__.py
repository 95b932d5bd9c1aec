"""Comparisons with other tools on the same work: `python -m benchmarks`. Needs the extra [benchmarks]."""
