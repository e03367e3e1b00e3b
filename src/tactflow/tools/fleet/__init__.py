"""Several sensors: one process for each, under one supervisor.

A process that fails is restarted with exponential back-off; the others go on. If several sinks publish at one
address, a proxy of ZeroMQ binds it and forwards messages and subscriptions, so that a process still knows
whether anybody listens. The core looks this tool up by its entry point, and knows nothing of it.
"""
