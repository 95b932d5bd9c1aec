"""Monte Carlo studies: an experiment is repeated many times, estimated in batches and summarised."""
