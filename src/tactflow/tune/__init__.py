"""The cheapest pipeline within an error budget, for one sensor: `tactflow tune`."""
