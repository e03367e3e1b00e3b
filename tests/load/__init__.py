"""Load and endurance of running processes; each writes its section of docs/reliability.md.

python -m tests.load.knee     # results, drops, latency and memory against the load: ten minutes
python -m tests.load.soak     # a million frames through all sinks, as fast as possible: an hour
"""
