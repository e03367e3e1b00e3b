"""Find the cheapest pipeline within an error budget for a sensor, from an unlabelled recording.

`recording` extracts the part with a contact, `sensor` fits the simulator to it, `space` lists candidates,
`measure` evaluates them, `search` chooses one, `report` writes the result. `propose` picks a shipped pipeline
for an unknown sensor.
"""
