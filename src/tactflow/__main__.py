"""`python -m tactflow` is the same as `tactflow`."""

from __future__ import annotations

from tactflow.cli.main import entry

if __name__ == "__main__":
    entry()
