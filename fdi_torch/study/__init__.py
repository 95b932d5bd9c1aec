"""Monte Carlo studies: many trials of one experiment, estimated in batches and summed up."""
