"""Foreign formats and systems; each can be deleted without a trace elsewhere."""
