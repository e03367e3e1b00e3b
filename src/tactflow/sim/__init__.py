"""The simulated sensor: recordings with known truth."""
