"""What a sensor's owner does beside running a pipeline: measure, diagnose, tune, process many recordings."""
