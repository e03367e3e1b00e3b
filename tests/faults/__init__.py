"""Faults around a run: each test lets one happen and compares the exit code, messages and files with the
promise."""
