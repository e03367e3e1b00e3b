"""The recordings of one session, or one live source: what `tactflow doctor` finds in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tactflow.engine.errors import ConfigError
from tactflow.recording.verdict import Finding, Grade, Verdict, extent, verdict_of
from tactflow.sources import sensors_in
from tactflow.system.redaction import public_address
from tactflow.tools.doctor.checks import examine, worst
from tactflow.tools.doctor.observation import observe
from tactflow.tools.doctor.step import Track, examine_session


@dataclass(frozen=True)
class Examined:
    """What was found in one source.

    Attributes
    ----------
    description : of its kind.
    size : (width, height), px.
    extent : how much there is of it.
    """

    source: str
    description: str
    live: bool
    frames: int
    size: tuple[int, int]
    extent: str
    findings: list[Finding]


@dataclass(frozen=True)
class Session:
    """What was found in the sources of a session.

    Attributes
    ----------
    together : about several of them as a whole.
    """

    parts: list[Examined]
    together: list[Finding]

    @property
    def findings(self) -> list[Finding]:
        """All findings."""
        return [*(finding for part in self.parts for finding in part.findings), *self.together]

    @property
    def worst(self) -> Grade:
        """The worst verdict of all findings."""
        return worst(self.findings)

    @property
    def has_fault(self) -> bool:
        """Whether there is a fault."""
        return self.worst == "fault"

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on finished recordings; None for a live source."""
        if self.parts[0].live:
            return None
        if len(self.parts) == 1:
            return verdict_of(self.findings, self.parts[0].extent)
        names = names_of([part.source for part in self.parts])
        named = [
            replace(finding, says=f"{name}: {finding.says}")
            for name, part in zip(names, self.parts, strict=True)
            for finding in part.findings
        ]
        texts = (f"{name}: {part.extent}" for name, part in zip(names, self.parts, strict=True))
        in_step = (finding.says for finding in self.together if finding.verdict == "good")
        return verdict_of([*named, *self.together], "; ".join([*texts, *in_step]))

    @property
    def says(self) -> str:
        """The verdict in one line; of a live source, how many faults there are."""
        if self.verdict is not None:
            return str(self.verdict)
        if self.worst == "good":
            return "no fault was found in these pictures"
        counts = [sum(finding.verdict == v for finding in self.findings) for v in ("fault", "warning")]
        return f"{counts[0]} faults, {counts[1]} warnings"


def examine_sources(
    sources: Sequence[str], seconds: float | None = None, report: Callable[[int], None] = lambda _: None
) -> Session:
    """Examine a source, or the recordings of one session.

    sources : as for `open_source`; a file with pictures of several sensors stands for all of them. seconds,
    report : as for `observe`.

    Raises
    ------
    ConfigError
        If one of several sources is live. SourceError as `observe`.

    >>> session = examine_sources(["sim:press?frames=90", "sim:press?frames=90&seed=8"])
    >>> session.verdict.word, session.together[0].verdict
    ('good', 'good')
    """
    expanded = [part for source in sources for part in sensors_in(source)]
    names = names_of(expanded)
    parts: list[Examined] = []
    tracks: list[Track] = []
    for name, source in zip(names, expanded, strict=True):
        observed = observe(source, seconds, report)
        if observed.live and len(expanded) > 1:
            raise ConfigError(f"{public_address(source)}: required finished recordings, or one live source")
        height, width = observed.pairs[0].image.shape[:2]
        findings, recorded = examine(observed), observed.recorded
        parts.append(
            Examined(
                source,
                observed.description,
                observed.live,
                observed.frames,
                (width, height),
                extent(recorded),
                findings,
            )
        )
        if recorded.timed:
            tracks.append(Track(name, recorded.course, observed.begins))
    return Session(parts, examine_session(tracks))


def names_of(sources: Sequence[str]) -> list[str]:
    """Short names of sources: of a file or of a topic, if they are all different.

    >>> names_of(["day/left.mcap", "day/right.mcap"]), names_of(["a.bag?topic=/l", "a.bag?topic=/r"])
    (['left.mcap', 'right.mcap'], ['/l', '/r'])
    """
    short = [
        source.partition("?topic=")[2] or (source if "?" in source else Path(source).name or source)
        for source in sources
    ]
    distinct = len(set(short)) == len(short)
    return [public_address(name) for name in (short if distinct else sources)]
