"""`tactflow schema`: JSON Schema of the result message or a pipeline file; a layout for Foxglove."""

from __future__ import annotations

import argparse
import json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `schema`."""
    parser.add_argument(
        "what",
        nargs="?",
        choices=("message", "pipeline", "foxglove-layout"),
        default="message",
        help="message: the result message (default); pipeline: a pipeline file; foxglove-layout: not a "
        "schema, but a layout of Foxglove that shows recordings, for Layouts > Import from file",
    )
    parser.add_argument("--sensor", default="main", metavar="NAME", help="of the layout (default: main)")


def run(args: argparse.Namespace) -> int:
    """Print the schema, or the layout."""
    if args.what == "message":
        from tactflow.message.schema import message_schema

        schema = message_schema()
    elif args.what == "foxglove-layout":
        from tactflow.recording.layout import layout

        schema = layout(args.sensor)
    else:
        from tactflow.config.registry import catalogue
        from tactflow.config.schema import pipeline_schema

        schema = pipeline_schema(catalogue()[0])
    print(json.dumps(schema, indent=2))
    return 0
