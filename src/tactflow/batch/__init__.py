"""A pipeline over many recordings: on the processors of this machine, on a Dask cluster, in shards.

`recordings` says which, `digests` what makes two results the same, `work` runs one recording, `local` and
`cluster` are the executors, `run` hands work out, `folder` is what stands in `--out`, `page` shows it.
"""
