"""Numerical stability, measured: `tactflow stress`.

Each part measures one kind of stress and returns a `Part`: checks of promises, tables and curves. `report`
makes the tables, the page and the JSON of them, `subjects` are the stages and pipelines that are stressed,
`inputs` the pictures.
"""
