"""Connections of other programs over ZeroMQ: results, commands, keys."""
