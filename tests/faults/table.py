"""The cases: what goes wrong, what is promised, what must be seen. Tests and docs/reliability.md use it."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tests.faults import readers, signals, sinks, sources
from tests.faults.rig import Seen


@dataclass(frozen=True)
class Case:
    """One fault.

    part : what it happens to. fault : what happens. promise : to the user. play : lets it happen, in an empty
    folder. exit, says, keeps : what must be seen; the last two are regular expressions. slow : takes longer
    than some seconds.
    """

    part: str
    fault: str
    promise: str
    play: Callable[[Path], Seen]
    exit: int
    says: str = "^$"
    keeps: str = ""
    slow: bool = False

    @property
    def name(self) -> str:
        """As tests are named."""
        return f"{self.part}: {self.fault}"

    def differences(self, seen: Seen) -> list[str]:
        """Where what was seen is not what must be."""
        found = [f"exit code {seen.exit} instead of {self.exit}"] if seen.exit != self.exit else []
        for pattern, text in ((self.says, seen.said), (self.keeps, seen.kept)):
            if not re.search(pattern, text, re.DOTALL):
                found.append(f"{text!r} does not match {pattern!r}")
        return found


ENDS = "the run ends and says so"
WRITING_STOPS = ENDS + "; "
LINES_STAY = "all lines written before stay, complete"
PICTURES_STAY = "all pictures written before stay; none is there in half"
FRAMES_STAY = "all frames written before can be played, and tactflow repair adds the index"
PARTS_STAY = "all parts written before stay, complete"
FILM_ENDS = "what it says about the film is what a player shows"
NOT_TOUCHED = "what is there is not touched"
NOT_WHOLE = "the run ends and says that the film is not whole"
TOLD = "the run ends and says that its results are not there"
SOME = "[1-9]"

FAULTS_OF_OUTPUTS: tuple[tuple[str, str, str, int, str, str], ...] = (
    ("jsonl", "disk full", WRITING_STOPS + LINES_STAY, 3, "No space left.* lines written before", "lines"),
    ("jsonl", "removed", TOLD, 3, "was removed by another program", "nothing"),
    ("jsonl", "replaced", TOLD + "; " + NOT_TOUCHED, 3, "was replaced by another", "the other's file"),
    ("jsonl", "turned into a pipe", TOLD, 3, "was replaced by another", "the pipe"),
    (
        "jsonl",
        "cut to nothing",
        "a warning; what follows is complete",
        0,
        "was cut by another",
        r"\d\d lines",
    ),
    ("images", "disk full", WRITING_STOPS + PICTURES_STAY, 3, "No space left.* pictures written", "pictures"),
    ("images", "removed", ENDS, 3, "cannot be written: No such file", "nothing"),
    ("images", "turned into a pipe", ENDS, 3, "cannot be written", "the pipe"),
    ("video .avi", "disk full", WRITING_STOPS + FILM_ENDS, 3, "the disk is full; ", "can be played"),
    ("video .avi", "removed", TOLD, 3, "was removed by another program", "nothing"),
    ("video .avi", "replaced", TOLD + "; " + NOT_TOUCHED, 3, "was replaced by another", "the other's file"),
    ("video .avi", "turned into a pipe", TOLD + "; nothing hangs", 3, "was replaced by another", "the pipe"),
    ("video .avi", "cut to nothing", NOT_WHOLE, 3, "it ends before its 120 frames", "can be played"),
    ("video .mkv", "disk full", WRITING_STOPS + FILM_ENDS, 3, "the disk is full; ", "can be played"),
    ("video .mkv", "cut to nothing", NOT_WHOLE, 3, "it ends before its 120 frames", "can be played"),
    ("video .mp4", "disk full", WRITING_STOPS + FILM_ENDS, 3, "the disk is full; ", "can be played"),
    ("video .mp4", "cut to nothing", NOT_WHOLE, 3, "it ends before its 120 frames", "can be played"),
    (
        "record",
        "disk full",
        WRITING_STOPS + FRAMES_STAY,
        3,
        "No space left.*tactflow repair",
        "frames can be",
    ),
    ("record", "removed", TOLD, 3, "was removed by another program", "nothing"),
    ("record", "replaced", TOLD + "; " + NOT_TOUCHED, 3, "was replaced by another", "the other's file"),
    ("record", "turned into a pipe", TOLD, 3, "was replaced by another", "the pipe"),
    ("record", "cut to nothing", TOLD, 3, "was cut by another program", "not an MCAP file"),
    ("parquet", "disk full", WRITING_STOPS + PARTS_STAY, 3, "No space left.* written before", "can be read"),
    ("parquet", "removed", ENDS, 3, "cannot be written into: No such file", "nothing"),
)
"""Sink, what happens to its output in mid-run, promise, exit code, what is said, what is left."""

SIZE_LIMITED = (
    ("jsonl", WRITING_STOPS + LINES_STAY, "File too large", f"{SOME}.* lines"),
    ("images", WRITING_STOPS + PICTURES_STAY, "File too large", f"{SOME}.* pictures"),
    ("video .avi", FILM_ENDS, "it ends before its 120 frames", "can be played"),
    ("video .mkv", FILM_ENDS, "it ends before its 120 frames", "can be played"),
    ("video .mp4", FILM_ENDS, "it cannot be played", "no frame"),
    ("record", WRITING_STOPS + FRAMES_STAY, "File too large", f"{SOME}.* frames can be played"),
)
"""Sink, promise, what is said, what is left where the size of files is limited."""

SIGNALS = (
    (signal.SIGKILL, "kill -9", "what was written until then can be read", -signal.SIGKILL),
    (signal.SIGTERM, "SIGTERM", "the frames under way are finished, every file is whole", 0),
    (signal.SIGINT, "Ctrl-C", "the frames under way are finished, every file is whole", 0),
)

PIPES = (
    ("recording", False, "never comes, and a signal comes", "one signal ends the run", 0, "^$", "some lines"),
    (
        "recording",
        False,
        "hangs, and a signal comes",
        "it ends, and says what was not read",
        3,
        "are lost",
        "",
    ),
    ("recording", False, "leaves", WRITING_STOPS + "nothing hangs", 3, "Broken pipe", "some lines"),
    ("live", True, "hangs", "the run goes on; lines are dropped and counted", 0, "too slow", "some dropped"),
    ("live", True, "leaves", WRITING_STOPS + "nothing hangs", 3, "Broken pipe", "some lines"),
)
"""Kind of run, the same as a flag, what the reader of a jsonl pipe does, promise, exit, said, left."""

UNHARMED = "the run and all others go on, and lose nothing"
SUBSCRIBERS = ("reads nothing", "subscribes to 100 kB", "sends noise")
VISITORS = ("connects and is silent", "leaves in mid-request", "sends noise")

ERROR = "the run ends, and names the file"
FINISHED = "the run goes on: the open file is read to its end"
RECORDINGS = (
    ("array (.npy)", "not there", True, ERROR, 4, "no such file", "nothing"),
    ("array (.npy)", "cut", True, ERROR, 4, "cut off", "nothing"),
    ("array (.npy)", "something else", True, ERROR, 4, "not a .npy file", "nothing"),
    ("array (.npy)", "removed", False, FINISHED, 0, "^$", "all results"),
    ("array (.npy)", "cut", False, ERROR, 4, "cut off during the run", "results up to there"),
    ("array (.npy)", "something else", False, ERROR, 4, "cut off during the run", "results up to there"),
    ("array (.npy)", "corrupt", False, "other pixels: nothing tells", 0, "^$", "all results"),
    ("folder of pictures", "not there", True, ERROR, 4, "no such file or folder", "nothing"),
    ("folder of pictures", "removed", False, ERROR, 4, r"frame-\d+.png: cannot be read", "up to there"),
    ("folder of pictures", "cut", False, ERROR, 4, "frame-90.png: the image is cut off", "up to there"),
    ("folder of pictures", "corrupt", True, ERROR, 4, "frame-90.png: not an image", "up to there"),
    ("folder of pictures", "one picture of another size", True, ERROR, 4, "80 x 60 pixels", "up to there"),
    ("video file", "not there", True, ERROR, 4, "no such file or folder", "nothing"),
    ("video file", "something else", True, ERROR, 4, "neither a video", "nothing"),
    ("video file", "cut", False, "a warning", 0, "ended after .* may be damaged", "up to there"),
    ("recording (.mcap)", "not there", True, ERROR, 4, "no such file or folder", "nothing"),
    ("recording (.mcap)", "something else", True, ERROR, 4, "is not an MCAP file", "nothing"),
    ("recording (.mcap)", "cut", True, "a warning", 0, "was not finished.*tactflow repair", "up to there"),
    ("recording (.mcap)", "corrupt", True, ERROR, 4, "is damaged.*tactflow repair", "up to there"),
    ("recording (.mcap)", "removed", False, FINISHED, 0, "^$", "all results"),
    ("recording (.mcap)", "something else", False, ERROR, 4, "is damaged", "up to there"),
)
"""Kind of source, what happens to it, whether before the run, promise, exit code, what is said and left."""

BACK = "reported, opened anew; results go on"
GIVEN_UP = "after `no_frame_timeout` the run ends and says why"
CAMERAS = (
    ("gone", "is gone since.*is back", "gone, no good frame"),
    ("ends", "is gone since.*is back", "gone, no good frame"),
    ("frozen", "a frozen picture since.*is back", "a frozen picture, no good frame"),
    ("black", "black pictures since.*is back", "black pictures, no good frame"),
    ("hangs", "no frames since.*is back", "no frames, no good frame"),
    ("other_size", "is back", "32 x 24 pixels instead of 64 x 48"),
)
"""What a camera does, what is said when it comes back, and when it does not."""


def _sinks() -> list[Case]:
    cases = [
        Case(kind, f"output {fault} in mid-run", promise, partial(sinks.in_mid_run, kind, fault), *expected)
        for kind, fault, promise, *expected in FAULTS_OF_OUTPUTS
    ]
    cases += [
        Case(kind, "size of files limited", promise, partial(sinks.size_limited, kind), 3, says, keeps)
        for kind, promise, says, keeps in SIZE_LIMITED
    ]
    for kind in ("jsonl", "images", "video .avi", "record", "parquet"):
        refused = "refused at the start; " + NOT_TOUCHED
        read_only, there = partial(sinks.read_only, kind), partial(sinks.at_once, kind)
        cases += [
            Case(kind, "read-only", "refused at the start", read_only, 3, "Read-only|denied", "nothing"),
            Case(kind, "an older file is there", refused, partial(there, "a file"), 3, "over", "the file"),
        ]
        if kind != "jsonl":
            pipe = partial(there, "a pipe")
            cases.append(Case(kind, "a pipe is there", refused + "; nothing hangs", pipe, 3, ".", "the pipe"))
    for option in ("--stats", "--trace"):
        full, and_source = "disk full", "disk full, and the source damaged"
        case = partial(sinks.statistics, option)
        cases += [
            Case(
                option, full, "said; the file is empty", partial(case, full), 3, f"{option}.*No space", "^0 "
            ),
            Case(
                option,
                and_source,
                "both are said; the source's error counts",
                partial(case, and_source),
                4,
                "damaged.*No space",
                "^0 ",
            ),
        ]
    return cases


def _signals() -> list[Case]:
    cases = [
        Case(
            kind,
            f"{name} at a random moment",
            promise,
            partial(signals.ended, kind, number),
            code,
            "^$",
            SOME,
        )
        for number, name, promise, code in SIGNALS
        for kind in signals.WRITES
    ]
    often = {
        signal.SIGKILL: "what was written can be read, whenever it comes",
        signal.SIGTERM: "it ends well at any moment, or has not begun: nothing is left in half",
    }
    often[signal.SIGINT] = often[signal.SIGTERM]
    cases += [
        Case(
            "all sinks",
            f"{name}, 10 runs",
            often[number],
            partial(signals.ended_often, number, 10),
            code,
            slow=True,
        )
        for number, name, _, code in SIGNALS
    ]
    kept = "it is started again and goes on beside what it had written, also with `overwrite`"
    keeps = (
        f"{SOME}.* lines; {SOME}.* pictures and {SOME}.* pictures; .* and .*frames can.*; .* and .*frames can"
    )
    cases.append(
        Case("one of two sensors", "kill -9", kept, signals.restarted, 0, "starting again", keeps, slow=True)
    )
    return cases


def _readers() -> list[Case]:
    cases = [
        Case(
            f"jsonl to a pipe, {run}",
            f"its reader {does}",
            promise,
            partial(readers.pipe, does, live=live),
            *expected,
        )
        for run, live, does, promise, *expected in PIPES
    ]
    cases += [
        Case("zmq", f"one {does}", UNHARMED, partial(readers.zeromq, does), 0, "^$", "got 120 messages")
        for does in SUBSCRIBERS
    ]
    cases += [
        Case("view", f"one {does}", UNHARMED, partial(readers.page, does), 0, "^$", "answers 200")
        for does in VISITORS
    ]
    return cases


def _sources() -> list[Case]:
    cases = [
        Case(
            kind,
            fault if at_start else f"{fault} in mid-run",
            promise,
            partial(sources.recording, kind, fault, at_start=at_start),
            *expected,
        )
        for kind, fault, at_start, promise, *expected in RECORDINGS
    ]
    for does, says, given_up in CAMERAS:
        name = does.replace("other_size", "of another size")
        back = partial(sources.camera, does, comes_back=True)
        gone = partial(sources.camera, does, comes_back=False)
        cases += [
            Case("camera", f"{name} for a while", BACK, back, 0, says, "before and after"),
            Case("camera", f"{name} for good", GIVEN_UP, gone, 4, given_up, "results before"),
        ]
    return cases


SECTIONS: dict[str, list[Case]] = {
    "What is written": _sinks(),
    "Signals": _signals(),
    "Who reads": _readers(),
    "Where frames come from": _sources(),
}
"""Title of a section of the page -> its cases."""

CASES = [case for cases in SECTIONS.values() for case in cases]
