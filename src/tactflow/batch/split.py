"""Cuts long recordings, lets an executor work on the parts side by side, and joins the results."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import orjson

from tactflow.batch.digests import result_key
from tactflow.batch.executor import Executor, Headway
from tactflow.batch.folder import Folder, remove
from tactflow.batch.parts import OVERLAP, cut
from tactflow.batch.summary import MOST_PICTURES, Curve, Point
from tactflow.batch.task import Outcome, Task, decoded
from tactflow.batch.work import commit, is_disk_full, kept_pipeline_for, moved_to_place, scratch_name
from tactflow.engine.errors import SourceError, StageError, TactflowError


@dataclass(slots=True)
class _Whole:
    """A recording that was cut. parts : tasks. ended : what became of those that have."""

    task: Task
    parts: Sequence[Task]
    ended: list[Outcome] = field(default_factory=list[Outcome])


class Splitting:
    """An `Executor` that cuts recordings for another one, and gives back one outcome for each recording.

    executor : works on the parts. Results of parts are in the scratch folder until all are there.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._wholes: dict[str, _Whole] = {}
        self.description = executor.description

    @property
    def window(self) -> int:
        """As of the other one, in recordings."""
        return self._executor.window

    def submit(self, task: Task) -> None:
        """See `Executor.submit`."""
        pipeline, _ = kept_pipeline_for(task.pipeline, task.format)
        parts = [replace(task, part=part) for part in cut(task.recording, pipeline, task.pipeline.split)]
        if parts:
            self._wholes[task.recording.source] = _Whole(task, parts)
        for one in parts or [task]:
            self._executor.submit(one)

    def finished(self, timeout: float) -> Sequence[Outcome]:
        """See `Executor.finished`."""
        outcomes: list[Outcome] = []
        for outcome in self._executor.finished(timeout):
            whole = self._wholes.get(outcome.recording)
            if whole is None:
                outcomes.append(outcome)
                continue
            whole.ended.append(outcome)
            if len(whole.ended) == len(whole.parts):
                del self._wholes[outcome.recording]
                outcomes.append(_joined(whole))
        return outcomes

    def headway(self) -> Sequence[Headway]:
        """See `Executor.headway`."""
        return self._executor.headway()

    def close(self, *, kill: bool) -> None:
        """See `Executor.close`."""
        self._executor.close(kill=kill)


def _joined(whole: _Whole) -> Outcome:
    """The outcome of a recording whose parts have all ended: that of the first that failed, or of all."""
    task = whole.task
    places = [Path(task.scratch, scratch_name(part)) for part in whole.parts]
    unfinished = Path(task.scratch, f"{scratch_name(task)}-joined")
    bad = next((outcome for outcome in whole.ended if outcome.status != "done"), None)
    blank = bad or whole.ended[0]
    try:
        if bad is not None:
            return bad
        told = [orjson.loads(place.with_suffix(".json").read_bytes()) for place in places]
        outcome = replace(_together(task, told), seconds=sum(one.seconds for one in whole.ended))
        there = Folder(Path(task.folder)).outcome_of(outcome.key)
        if there is not None:
            return replace(there.of(task.recording), input=outcome.input, reused=True)
        _join_files(places, unfinished, task)
        outcome = moved_to_place(task, outcome, unfinished)
        commit(task, outcome, _told(told))
        return outcome
    except (TactflowError, OSError, ValueError) as error:
        return replace(blank, status="failed", error=str(error), disk_full=is_disk_full(error))
    finally:
        for place in (*places, *(place.with_suffix(".json") for place in places), unfinished):
            with suppress(OSError):
                remove(place)


def _together(task: Task, told: Sequence[Mapping[str, Any]]) -> Outcome:
    """One outcome of those of all parts, in their order."""
    parts = [part for one in told if (part := decoded(orjson.dumps(one["outcome"]))) is not None]
    if len(parts) < len(told):
        raise StageError(f"{task.recording.source}: the outcome of a part cannot be read; call again")
    first = parts[0]
    if any(part.input != first.input for part in parts):
        raise SourceError(f"{task.recording.path}: was changed while it was read; call again")
    lasting = sum(one["ends"][1] and other["ends"][0] for one, other in itertools.pairwise(told))
    note = (
        f"cut into {len(parts)} parts, each with {OVERLAP} frames before it: numbers may differ from those "
        "of the whole"
    )
    return replace(
        first,
        key=result_key(first.input_digest, task.pipeline.digest),
        frames=sum(part.frames for part in parts),
        dropped=sum(part.dropped for part in parts),
        duration=parts[-1].duration,
        contacts=sum(part.contacts for part in parts) - lasting,
        touching=sum(part.touching for part in parts),
        largest=max(part.largest for part in parts),
        notes=(note, *dict.fromkeys(text for part in parts for text in part.notes)),
    )


def _told(told: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One curve, and the pictures of the largest contacts."""
    curve = Curve()
    for one in told:
        for point in one["curve"]:
            curve.add(Point(*point))
    pictures = sorted((p for one in told for p in one["pictures"]), key=lambda p: -p["area"])
    kept = sorted(pictures[:MOST_PICTURES], key=lambda p: int(p["seq"]))
    return {"curve": [tuple(point) for point in curve.points], "pictures": kept}


def _join_files(places: Sequence[Path], unfinished: Path, task: Task) -> None:
    """One file of lines, or one folder of tables, of those of all parts."""
    if task.format == "jsonl":
        with unfinished.open("wb") as whole:
            for place in places:
                with place.open("rb") as part:
                    shutil.copyfileobj(part, whole)
        return
    for table in sorted(path.name for path in places[0].iterdir()):
        folder = unfinished / table
        folder.mkdir(parents=True)
        files = [file for place in places for file in sorted((place / table).glob("*.parquet"))]
        for number, file in enumerate(files):
            file.replace(folder / f"part-{number:05d}.parquet")
