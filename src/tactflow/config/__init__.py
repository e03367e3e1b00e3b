"""The pipeline file: read, checked, and turned into the graph that the engine runs."""
