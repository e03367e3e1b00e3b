"""The cheapest pipeline within an error budget for a sensor, from a recording without labels.

`recording` takes the part with a contact, `sensor` makes the simulator look like it, `space` lists pipelines,
`measure` judges them, `search` narrows them down, `report` writes what was found.
"""
