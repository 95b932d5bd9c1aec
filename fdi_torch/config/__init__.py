"""Configuration: strict models of plant files and run files, with units; errors are sentences."""
