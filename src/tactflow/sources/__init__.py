"""What capture opens: simulated sensors, files, folders, cameras, streams."""
