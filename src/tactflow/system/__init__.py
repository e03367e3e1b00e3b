"""The operating system: files, signals, time, optional packages, and secrets kept out of logs."""
