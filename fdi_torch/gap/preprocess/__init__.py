"""Preparation of recordings before a diagnosis: acquisition faults, stuck sensors, outliers, sensor limits."""
