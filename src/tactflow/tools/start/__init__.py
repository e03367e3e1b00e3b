"""Setting up a sensor: which pipeline fits its pictures."""
