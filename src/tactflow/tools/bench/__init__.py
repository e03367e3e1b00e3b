"""Run time against error: every method of every stage, and whole pipelines, on scenes with known truth."""
