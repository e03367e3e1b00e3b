"""Guided sessions shown on the live page, such as the presses of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

from tactflow.engine.contract import Sink


class Session(Protocol):
    """A guided session; thread-safe."""

    state: Mapping[str, Any]
    """Next step and progress, for the page; replaced as a whole."""


class Guiding(Sink):
    """A sink that can show a guided session."""

    session: ClassVar[Session | None] = None
    """The session of this run, if any."""

    @classmethod
    def through(cls, session: Session) -> type[Self]:
        """Create a subclass of this sink that shows a session."""
        return type(cls.__name__, (cls,), {"session": session})
