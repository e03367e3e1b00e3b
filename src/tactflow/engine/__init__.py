"""The dataflow engine: frames, stages, links, planning, running. Knows nothing of vision."""
