"""Load and endurance of running processes; each writes its section of docs/reliability.md.

python -m benchmarks.load.knee     # results, drops, latency and memory against the load: ten minutes
python -m benchmarks.load.soak     # a million frames through all sinks, as fast as possible: an hour
"""
