"""Foreign formats and systems, found by entry points: each can be deleted with its lines in pyproject."""
