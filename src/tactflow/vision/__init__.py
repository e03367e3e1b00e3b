"""Pure functions on arrays: images in, geometry out. Knows nothing of the engine; import it in a notebook."""
