"""Built-in stages: one file, one stage."""
