"""Parameter estimation: global search, local refinement, and uncertainty of the result."""
