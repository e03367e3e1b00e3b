"""A layout of Foxglove for recordings: the picture with what was found on it, and plots."""

from __future__ import annotations

from typing import Any


def layout(sensor: str) -> dict[str, Any]:
    """The layout for one sensor, as Foxglove exports and imports it.

    >>> layout("left")["configById"]["Image!tactflow"]["imageMode"]["imageTopic"]
    '/left/image'
    """
    annotations = {f"/{sensor}/annotations": {"visible": True}}
    plots = {
        "Plot!contact": ("Contact, px²", ["contact.area"]),
        "Plot!flow": ("Mean flow, px", ["flow.mean[0]", "flow.mean[1]"]),
        "Plot!angle": ("Angle of the contact, degrees", ["contact.angle"]),
    }
    configurations: dict[str, Any] = {
        "Image!tactflow": {
            "foxglovePanelTitle": sensor,
            "imageMode": {"imageTopic": f"/{sensor}/image", "annotations": annotations},
        },
        "RawMessages!results": {"topicPath": f"/{sensor}/results", "foxglovePanelTitle": "Results"},
    }
    for name, (title, paths) in plots.items():
        configurations[name] = {
            "foxglovePanelTitle": title,
            "paths": [
                {"value": f"/{sensor}/results.{path}", "enabled": True, "timestampMethod": "receiveTime"}
                for path in paths
            ],
            "xAxisVal": "timestamp",
            "showLegend": True,
        }
    right = {
        "direction": "column",
        "first": "Plot!contact",
        "second": {"direction": "column", "first": "Plot!flow", "second": "Plot!angle"},
    }
    left = {"direction": "column", "first": "Image!tactflow", "second": "RawMessages!results"}
    return {
        "configById": configurations,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": left | {"splitPercentage": 75}, "second": right},
    }
