"""Calibration of a sensor: from pixels to millimetres and depth.

`file` is the calibration file, `scale` finds millimetres per pixel, `presses` finds presses of a ball in a
recording, `photometric` learns from them which slope of the gel has which colour.
"""
