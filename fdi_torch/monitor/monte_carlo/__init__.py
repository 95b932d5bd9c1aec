"""Monte Carlo validation of a monitor on simulated runs: false alarms, detection delays, isolation, estimators."""
