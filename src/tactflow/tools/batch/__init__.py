"""Run a pipeline over many recordings, on local processes or on a Dask cluster.

`recordings` finds the recordings, `run` submits outdated ones to `workers`, `work` processes one recording,
`summary` collects its curves and pictures, `store` manages the output folder, `report` writes the table and
page of all runs.
"""
