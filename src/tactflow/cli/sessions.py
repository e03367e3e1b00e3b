"""Recordings of several sensors in one session: their results, with times of one clock."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tactflow.message.result import Result

log = logging.getLogger("tactflow")


def of_sensors(pipeline: str | None, recordings: Mapping[str, str]) -> dict[str, Iterable[Result]]:
    """The results of each sensor, with pictures.

    Times are Unix times if every recording has them. Otherwise all are taken to begin at the same moment,
    t = 0, with a warning.

    Parameters
    ----------
    pipeline : as for `tactflow.load`; if it has `sensors:`, each recording is processed by that of its name.
    recordings : sensor -> source.

    Raises
    ------
    ConfigError : the pipeline file is wrong, or has sensors and none of this name. SourceError : a recording
        cannot be opened.
    """
    from tactflow.config.load import sensor_names
    from tactflow.config.shipped import find_pipeline
    from tactflow.sources import open_source
    from tactflow.streaming import stream

    begins: dict[str, float | None] = {}
    for name, recording in recordings.items():
        source = open_source(recording)
        begins[name] = source.begins
        source.close()
    unknown = [recordings[name] for name, begin in begins.items() if begin is None]
    if unknown:
        log.warning("%s: no Unix times; all recordings are taken to begin together", ", ".join(unknown))
    several = bool(sensor_names(find_pipeline(pipeline)))
    results: dict[str, Iterable[Result]] = {}
    for name, recording in recordings.items():
        named = {} if several else {"sensor": name}
        found = stream(
            pipeline,
            source=recording,
            settings={"sinks": {}, **named},
            sensor=name if several else None,
            images=True,
        )
        results[name] = _shifted(found, None if unknown else begins[name])
    return results


def _shifted(results: Iterable[Result], begin: float | None) -> Iterator[Result]:
    """The results with times from `begin` on, s; None: from the first one on."""
    for result in results:
        begin = -result.t if begin is None else begin
        shifted = copy(result)
        shifted.frame = replace(result.frame, t=result.t + begin)
        yield shifted
