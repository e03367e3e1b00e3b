"""Hostile input: every parser of bytes from elsewhere, fed with valid samples that were damaged."""
