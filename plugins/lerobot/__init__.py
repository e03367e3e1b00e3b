"""LeRobot data sets: a source and an export. Its camera is a distribution of its own, in `camera/`."""
