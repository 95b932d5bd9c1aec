"""Whole jobs, one a file: what a command asks for is read, computed, logged and drawn. The commands call these."""
