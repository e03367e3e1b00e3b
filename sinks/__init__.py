"""Built-in sinks: one file, one sink."""
