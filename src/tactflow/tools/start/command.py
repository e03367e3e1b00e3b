"""`tactflow start`: set up a sensor, from the camera to a pipeline file and live results."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from tactflow.cli.cameras import NO_CAMERA
from tactflow.cli.options import add_overwrite, add_source, refuse_output, writing
from tactflow.config.load import load_pipeline
from tactflow.config.overrides import from_settings
from tactflow.config.shipped import described_pipelines, find_pipeline
from tactflow.engine.errors import ConfigError, SourceError, StageError
from tactflow.sources import Arrival, FrameReader, open_source
from tactflow.sources.cameras import list_cameras
from tactflow.system.files import completed
from tactflow.system.redaction import public_address
from tactflow.system.signals import INTERRUPTED_EXIT_CODE, ending_handled, interrupt
from tactflow.system.terminal import notes, say, typed
from tactflow.tools.doctor import Observation, examine
from tactflow.tools.doctor.observation import watch
from tactflow.tools.start.propose import MIN_FOUND_SHARE, SPECIAL_PIPELINES, Attempt, Sample, divide, propose
from tactflow.tools.tune.recording import CONTACT_CHANGE, Kept
from tactflow.tools.tune.report import commented
from tactflow.view.questions import Questions

REST_SECONDS: Final = 2.0
"""How long the untouched gel is observed, s."""
RECORDED_SECONDS: Final = 30.0
"""How much of a recording is read, s."""
EDGES: Final = {"0": "top", "270": "right", "180": "bottom", "90": "left"}
"""Value of `rotate`, degrees clockwise -> edge of the picture that it brings to the top."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `start`."""
    add_source(parser, "as in 'tactflow run'; default: a camera that is plugged in")
    parser.add_argument(
        "--yes", action="store_true", help="accept every proposal for a recording, without asking"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("pipeline.yaml"), metavar="FILE", help="default: pipeline.yaml"
    )
    add_overwrite(parser)
    parser.add_argument("--no-run", action="store_true", help="write the file, but do not run it")
    parser.set_defaults(dev=Path("/dev"), port=8780)


def run(args: argparse.Namespace) -> int:
    """Ask, propose, write, run; returns the exit code.

    Raises
    ------
    ConfigError
        The file is there already, --yes without a recording, or nobody can answer.
    SourceError
        There is no camera, or the source delivers nothing.
    StageError
        With --yes: no pipeline finds the presses.
    """
    refuse_output("--out", args.out, overwrite=args.overwrite, suffixes=(".yaml", ".yml"))
    questions = Questions(None if args.yes else args.port, say)
    try:
        with ending_handled(interrupt), notes("ERROR"), closing(questions):
            source, reader = _open(args, questions)
            with closing(reader):
                _set_up(args, source, reader, questions)
    except KeyboardInterrupt:
        say("stopped; nothing was written")
        return INTERRUPTED_EXIT_CODE
    say(f"{args.out} is written. From now on: {typed('tactflow', 'run', str(args.out))}")
    if args.no_run:
        return 0
    say("Leave the gel untouched while it starts.")
    from tactflow.cli.main import make_parser

    # The page stays at its address.
    port = [] if questions.url is None else ["--set", f"sinks.view.port={questions.port}"]
    live = make_parser("run").parse_args(["run", str(args.out), *port])
    return int(live.run(live))


def _open(args: argparse.Namespace, questions: Questions) -> tuple[str, FrameReader]:
    """The source that was named, or the camera that is the sensor."""
    sources = [args.source] if args.source is not None else _cameras(args.dev)
    problems: list[str] = []
    while len(problems) < len(sources):
        problems = []
        for source in sources:
            try:
                reader = open_source(source)
                reader.peek()
            except SourceError as error:
                problems.append(str(error))
                continue
            if args.yes and reader.live:
                reader.close()
                raise ConfigError("--yes: required a recording as SRC; with a camera, somebody has to press")
            questions.reader = reader if reader.live else None
            choices = {"yes": "Yes, this is the sensor", "no": "No, show the next camera"}
            if len(sources) == 1 or questions.ask(f"Is this the sensor? {source}", choices) == "yes":
                return source, reader
            reader.close()
    raise SourceError("\n".join(problems))


def _cameras(dev: Path) -> list[str]:
    """Sources of the cameras that deliver pictures; outside Linux they have numbers, and no list."""
    if not sys.platform.startswith("linux"):
        return ["0", "1", "2"]
    cameras = list_cameras(dev)
    found = [camera.source for camera in cameras if camera.pictures]
    if not found:
        raise SourceError(f"{NO_CAMERA}\n  to try it without one: tactflow start sim:press")
    return found


def _set_up(args: argparse.Namespace, source: str, reader: FrameReader, questions: Questions) -> None:
    """Ask and propose until a pipeline is accepted, and write it. Raises KeyboardInterrupt if none is."""
    left_out = SPECIAL_PIPELINES | {"default", "markerless"}
    named = {name: what for name, what in described_pipelines().items() if name not in left_out}
    answer = questions.ask("Which sensor is this?", {"unknown": "Another one, or unknown"} | named)
    kind = answer if answer in named else None
    edges = {value: f"{edge} edge" for value, edge in EDGES.items()}
    answer = "again"
    while answer == "again":
        kept = Kept()
        observation = Observation(source, reader.description, reader.live)
        if reader.live:
            rest, kept = _untouched(source, reader, questions)
            at_rest = len(kept)
        else:
            _watch(reader, RECORDED_SECONDS, observation, questions, kept)
            sample = divide(kept.frames)
            questions.show(sample.frames[sample.strongest])
        text = "Where is the end of the gel that points away from the cable? Press it, and choose its edge."
        rotate = int(questions.ask(text, edges))
        if reader.live:
            _press(reader, observation, questions, kept)
            observation.pairs[:0] = rest.pairs
            sample = divide(kept.frames, at_rest)
        questions.begin("Trying pipelines on these pictures ...")
        dots = observation.dots
        attempts = propose(sample, None if dots is None else dots.pitch, rotate, kind, say)
        faults = [found for found in examine(observation) if found.verdict in ("warning", "fault")]
        remarks = [f"{fault.name}: {fault.says}; {fault.effect}. Change: {fault.advice}" for fault in faults]
        answer = _decide(args, attempts[0], sample, remarks, questions)
    if answer == "quit":
        raise KeyboardInterrupt
    _write(args.out, source, attempts, remarks)


def _watch(
    reader: FrameReader,
    seconds: float,
    observation: Observation,
    questions: Questions,
    kept: Kept,
    *,
    at_rest: bool = False,
    until: str = "",
) -> None:
    """Observe, keep and show frames, for some seconds or to an answer. Raises SourceError without frames."""

    def show(arrival: Arrival) -> bool:
        questions.show(arrival.image)
        kept.add(arrival.image, at_rest=at_rest)
        return not until or questions.poll() != until

    watch(reader, seconds, observation, show)
    observation.check()


def _untouched(source: str, reader: FrameReader, questions: Questions) -> tuple[Observation, Kept]:
    """Look at the gel at rest."""
    text = "Leave the gel untouched."
    while True:
        questions.ask(text, {"untouched": "Nothing touches the gel"})
        questions.begin(f"Looking at the untouched gel for {REST_SECONDS:.0f} s ...")
        rest, kept = Observation(source, reader.description, live=True), Kept()
        _watch(reader, REST_SECONDS, rest, questions, kept, at_rest=True)
        change = max(divide(kept.frames, len(kept)).changes)
        if change < CONTACT_CHANGE:
            return rest, kept
        text = (
            f"The picture changed by {100 * change:.0f} %, although nothing should touch the gel. Keep away "
            "from it, and from its light, for a moment."
        )


def _press(reader: FrameReader, observation: Observation, questions: Questions, kept: Kept) -> None:
    """Look at presses."""
    questions.begin("Press the gel in several places, and lift in between.", {"done": "Done"})
    _watch(reader, math.inf, observation, questions, kept, until="done")


def _decide(
    args: argparse.Namespace, best: Attempt, sample: Sample, remarks: Sequence[str], questions: Questions
) -> str:
    """Show the proposal; returns write, again or quit. Raises StageError if --yes has nothing to accept."""
    choices = {"write": f"Write {args.out}" + ("" if args.no_run else " and go on live")}
    if questions.reader is not None:
        choices["again"] = "Look again"
    choices["quit"] = "Quit"
    text = f"Proposed: {best}"
    if not sample.pressed:
        text = f"No press was seen, so that contacts are untested. {text}"
    elif best.failure or best.found < MIN_FOUND_SHARE:
        del choices["write"]
        text = f"No pipeline finds the presses of this gel. The best is {best}"
    if args.yes:
        if "write" not in choices:
            raise StageError("\n".join([text, *remarks]))
        say("\n".join([*remarks, text]))
    if best.picture is not None:
        questions.show(best.picture)
    return questions.ask(text, choices, notes=remarks, still=True)


def _write(out: Path, source: str, attempts: Sequence[Attempt], remarks: Sequence[str]) -> None:
    """Write the first pipeline, with what was measured as comments."""
    file = find_pipeline(attempts[0].pipeline)
    title = f"Made by tactflow start for {public_address(source)}, from {file.name}. Tried on its pictures:"
    settings = {"stages.capture.source": source, **attempts[0].settings}
    pipeline = load_pipeline(file, from_settings(settings))
    text = commented(pipeline, [title, *(f"  {attempt}" for attempt in attempts), *remarks], out)
    with writing(out), completed(out) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
