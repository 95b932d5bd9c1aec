"""The job behind each command: read the input, compute, log and draw."""
