"""Several sensors: one process for each, under one supervisor.

A process that fails is restarted with exponential back-off; the others go on. If several sinks publish at one
address, a relay binds it and forwards messages and subscriptions, so that a process still knows whether
anybody listens. No sink is known by name here: sinks declare what they write and where they publish
(`tactflow.engine.contract.Sink`).
"""
