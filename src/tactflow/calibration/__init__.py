"""Calibration of a sensor: from pixels to millimetres, depth and force.

`file` is the calibration file; `scale` and `target` find millimetres per pixel, `presses` finds presses of a
ball in results, `photometric` learns from them which slope of the gel has which colour, and `force` how the
force follows from a contact. Nothing here runs a pipeline: results come in, numbers go out.
"""
