"""Plug-in: live results for Foxglove."""
