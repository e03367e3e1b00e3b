"""The live view: a browser page that shows a running pipeline.

`hub` schedules messages to pages, `compact` encodes them, `server` is an HTTP and WebSocket server in a
thread, `page/` contains the browser code. The sink `tactflow.sinks.view` feeds the hub.
"""
