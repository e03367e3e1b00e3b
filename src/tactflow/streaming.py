"""Results of a run in the same process: `for result in tactflow.stream("pipeline.yaml"): ...`."""

from __future__ import annotations

import threading
from collections.abc import Generator
from pathlib import Path

from tactflow.api import Frames, Settings, load, make_runner
from tactflow.engine.collect import with_collector
from tactflow.engine.graph import Pipeline
from tactflow.engine.link import Link
from tactflow.engine.run import Runner
from tactflow.message.result import Result


def stream(
    pipeline: str | Path | Pipeline | None = None,
    *,
    source: str | Path | Frames | None = None,
    settings: Settings | None = None,
    sensor: str | None = None,
    realtime: bool = False,
    max_frames: int | None = None,
    images: bool = False,
    sinks: bool = False,
) -> Generator[Result, None, None]:
    """Run a pipeline and iterate over its results.

    The run continues in the background while the loop processes a result. A recording waits for the loop, so
    nothing is lost; a live source gives the loop the newest result. Leaving the loop ends the run.

    Parameters
    ----------
    pipeline, source, settings, sensor, realtime : as for `tactflow.load`, or a loaded pipeline.
    max_frames : stop after this many frames.
    images : keep the pictures in each result: `image`, `frame.image`, and every other (H, W, 3) uint8 array.
        Without them a list of results stays small.
    sinks : also run the pipeline's sinks: files, ZeroMQ, the live page.

    Raises
    ------
    ConfigError : at once, if the pipeline file is wrong.
    TactflowError : from the loop, if a stage or the source failed.

    Examples
    --------
    >>> import tactflow
    >>> areas = [r.contact.area for r in tactflow.stream(source="sim:press", max_frames=50) if r.contact]
    >>> len(areas) > 10
    True
    """
    if not isinstance(pipeline, Pipeline):
        pipeline = load(pipeline, source=source, settings=settings, sensor=sensor, realtime=realtime)
    link: Link[Result] = Link("tactflow.stream", 1, "block")

    def hand_over(result: Result) -> None:
        # From a live source only the newest result is kept for the loop.
        if runner.source is not None and runner.source.live:
            link.when_full = "latest"
        link.put(result.kept(pictures=images))

    collecting = with_collector(pipeline, Result, hand_over, name=link.name, sinks=sinks, background=True)
    runner = make_runner(collecting, max_frames=max_frames)
    return _results(runner, link)


def _results(runner: Runner, link: Link[Result]) -> Generator[Result, None, None]:
    failures: list[BaseException] = []

    def work() -> None:
        try:
            failure = runner.run().failure
            failures.extend([failure] if failure is not None else [])
        except BaseException as error:
            failures.append(error)
        finally:
            link.close()

    thread = threading.Thread(target=work, name="tactflow-stream", daemon=True)
    thread.start()
    try:
        while (result := link.get()) is not None:
            yield result
    finally:
        runner.stop()
        link.abort()
        thread.join()
    if failures:
        raise failures[0]
