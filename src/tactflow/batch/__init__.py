"""A pipeline over many recordings, on the processors of this machine or on a Dask cluster.

`recordings` finds them, `run` decides what is missing and hands it to `workers`, `work` runs one recording,
`summary` keeps curves and pictures of it, `store` is the folder of the results, `report` the table and the
page of all runs, `compare` a table of how two pipelines differ.
"""
