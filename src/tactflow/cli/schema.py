"""`tactflow schema`: JSON Schema of the result message, or of a pipeline file."""

from __future__ import annotations

import argparse
import json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `schema`."""
    parser.add_argument(
        "what", nargs="?", choices=("message", "pipeline"), default="message", help="default: message"
    )


def run(args: argparse.Namespace) -> int:
    """Print the schema."""
    if args.what == "message":
        from tactflow.message import message_schema

        schema = message_schema()
    else:
        from tactflow.config.registry import available
        from tactflow.config.schema import pipeline_schema

        schema = pipeline_schema(available())
    print(json.dumps(schema, indent=2))
    return 0
