"""Plain versions, in NumPy and OpenCV, of compiled loops: to be read, and to test against."""
