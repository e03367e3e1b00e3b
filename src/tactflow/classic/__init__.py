"""The original script, faithfully: its functions, and stages for `pipelines/classic.yaml`."""
