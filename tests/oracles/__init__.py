"""Plain versions of the compiled kernels, to be read, to test against, and to measure the gain.

A module here holds the oracles of one module of the package: plain functions of numpy and OpenCV, and a list
`GAINS` with one entry for each kernel:

    from tactflow.vision.geometry.moments import measure_region
    from tests.oracles.gains import Gain

    def plain_measure_region(mask, ends): ...    # takes, fills and returns what the kernel does

    GAINS = [Gain(measure_region, plain_measure_region)]

Both are called with what the default pipeline gives to the kernel; see `Gain` for other ways.
`tests/oracles/test_gains.py` holds that they agree, `make kernels` measures them and writes docs/kernels.md.
"""
