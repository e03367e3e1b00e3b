"""The live view: a page in the browser that shows a run while it lasts.

`hub` decides who is sent what and when, `compact` makes it small, `server` speaks HTTP and WebSocket on its
own thread, `page/` holds what the browser runs. The sink `tactflow.sinks.view` feeds them. `guided` is for a
page that guides people through a session.
"""
