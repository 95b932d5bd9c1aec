"""Competing methods for the blind benchmark of the gap diagnosis."""
