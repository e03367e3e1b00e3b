"""The result of a frame: in Python, as a JSON message, and its schema."""
