"""What makes two results the same: the input, the pipeline with all that it reads, and the versions."""

from __future__ import annotations

import errno
import functools
import hashlib
import os
import stat
import sys
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import orjson

import tactflow
from tactflow.batch.recordings import Recording
from tactflow.config.files_used import files_named
from tactflow.engine.errors import SourceError, StageError
from tactflow.engine.graph import Node, Pipeline

LIBRARIES = ("numpy", "opencv-contrib-python-headless", "numba")
"""Packages whose version may change a number."""
COMPUTING = (
    *("calibration", "classic", "engine", "recording", "sim", "sinks", "sources", "stages", "vision"),
    *("message", "adapters"),
)
"""Rooms and modules whose code may change a number."""


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """What the system says about a file or folder: if it has not changed, neither have the bytes.

    size : bytes. changed : time of the last change, ns; of a folder, the latest one in it.
    """

    size: int
    changed: int


def fingerprint(path: Path) -> Fingerprint:
    """Of a file, or of all files in a folder.

    Raises OSError if it is not there, or if one is a pipe or a device: reading it would not end.
    """
    if not path.is_dir():
        found = _regular(path)
        return Fingerprint(found.st_size, found.st_mtime_ns)
    files = [_regular(file) for file in _files(path)]
    return Fingerprint(sum(f.st_size for f in files), max((f.st_mtime_ns for f in files), default=0))


def _regular(path: Path) -> os.stat_result:
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", str(path))
    return found


def _files(folder: Path) -> list[Path]:
    """All files in a folder, in an order that every machine has."""
    return sorted(Path(place, name) for place, _, names in os.walk(folder) for name in names)


def digest_of(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of all files in a folder. Raises OSError."""
    if not path.is_dir():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    whole = hashlib.sha256()
    for file_path in _files(path):
        whole.update(os.fsencode(file_path.relative_to(path)) + b"\0" + digest_of(file_path).encode())
    return whole.hexdigest()


@functools.lru_cache(maxsize=4)
def _content(path: Path, _now: Fingerprint) -> str:
    """Digest of a file or folder; read once for all recordings in it."""
    return digest_of(path)


def input_digest(recording: Recording) -> str:
    """SHA-256 of a recording and of how it is opened; of the simulated sensor, that of its description.

    >>> input_digest(Recording("sim:press?frames=3", "press"))[:8]
    '9cd947a0'

    Raises
    ------
    SourceError : it cannot be read.
    """
    path, options = recording.path, recording.source
    try:
        content = "" if path is None else _content(path, fingerprint(path))
    except OSError as error:
        raise SourceError(f"{error.filename or path}: cannot be read: {error.strerror or error}") from error
    if path is not None:
        # Where it lies does not matter.
        options = options.replace(str(path), "", 1)
    return hashlib.sha256(f"{content}{options}".encode(errors="surrogateescape")).hexdigest()


@functools.cache
def versions() -> dict[str, str]:
    """What computes here: Python, tactflow with a digest of its code, libraries behind the numbers."""
    found = {"python": sys.version.split()[0], "tactflow": f"{tactflow.__version__}+{_code()}"}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            # Another wheel of OpenCV, or none.
            found[name] = "unknown"
    return found


def _code() -> str:
    """Digest of the code that computes: in a clone, it changes while the version stays the same."""
    whole = hashlib.sha256()
    for name in COMPUTING:
        found = find_spec(f"tactflow.{name}")
        assert found is not None, "it comes with this one"
        rooms = found.submodule_search_locations
        files = [Path(str(found.origin))] if rooms is None else sorted(Path(rooms[0]).rglob("*.py"))
        for file in files:
            whole.update(file.read_bytes())
    return whole.hexdigest()[:8]


_NO_MATTER = {"path", "overwrite", "append", "flush"}
"""Parameters of a sink that say where and when it writes, not what."""


def pipeline_digest(pipeline: Pipeline) -> str:
    """SHA-256 of all that decides what a pipeline makes of a recording.

    That is its settings without source and sinks, the calibration, every file that a setting names, code
    beside the pipeline, plug-ins, the sink that writes the result, and the versions.

    Raises
    ------
    StageError : one of these files cannot be read.
    """
    settings = {key: value for key, value in pipeline.settings.items() if key not in ("sinks", "stages")}
    nodes = [node for node in pipeline.nodes.values() if node.component.kind != "sink"]
    stages = {node.id: _without_source(pipeline, node) for node in nodes}
    sinks = [[node.component.origin, node.params.model_dump(exclude=_NO_MATTER)] for node in pipeline.sinks]
    described = {
        "settings": settings,
        # In the order of the file: an input is taken from the nearest stage above.
        "stages": list(stages.items()),
        "sinks": sinks,
        "files": sorted({_file_digest(path) for node in nodes for path in _other_files(pipeline, node)}),
        "plug-ins": sorted({node.component.origin for node in nodes}),
        "versions": {key: value for key, value in versions().items() if key != "python"},
    }
    return hashlib.sha256(orjson.dumps(described, option=orjson.OPT_SORT_KEYS, default=str)).hexdigest()


def result_key(input_: str, pipeline: str) -> str:
    """The key of a result: SHA-256 of both digests."""
    return hashlib.sha256(f"{input_}\n{pipeline}".encode()).hexdigest()


def _without_source(pipeline: Pipeline, node: Node) -> Any:
    settings = dict(pipeline.settings.get("stages", {}).get(node.id) or {})
    if node.id == pipeline.source.id:
        for name in ("source", "realtime"):
            settings.pop(name, None)
    return settings


def _other_files(pipeline: Pipeline, node: Node) -> set[Path]:
    """Files besides the recording that a stage reads or is made of."""
    params = node.params
    if node.id == pipeline.source.id:
        params = params.changed(source="")
    found = {path for path in files_named(params, pipeline.directory) if path.is_file()}
    if pipeline.calibration is not None:
        found.add(pipeline.calibration)
    module = sys.modules.get(node.component.cls.__module__)
    code = getattr(module, "__file__", None)
    if code is not None and not node.component.cls.__module__.startswith("tactflow."):
        found.add(Path(code))
    return found


def _file_digest(path: Path) -> str:
    try:
        return digest_of(path)
    except OSError as error:
        raise StageError(f"{path}: cannot be read: {error.strerror or error}") from error
