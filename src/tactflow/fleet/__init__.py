"""Several sensors: one process for each, under one supervisor.

Each process runs the pipeline for its sensor. A process that fails is started again with a growing pause;
the others go on. What several publish at one address comes out there: a relay binds it and passes messages
on, and subscriptions back, so that a process still knows whether anybody listens.

Nothing here knows a sink by name: sinks declare what they write and where they publish
(`tactflow.engine.contract.Sink`).
"""
