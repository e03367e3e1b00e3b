"""A session that people are guided through while a run lasts, such as the presses of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

from tactflow.engine.contract import Sink


class Session(Protocol):
    """A session that is followed while the run lasts. From any thread."""

    state: Mapping[str, Any]
    """What to do now and what was done, as the page takes it; replaced as a whole."""

    def undo(self) -> None:
        """Forget the last step."""


class Guiding(Sink):
    """A sink that can guide people through a session."""

    session: ClassVar[Session | None] = None
    """The session that the run is part of; None in any other run."""

    @classmethod
    def through(cls, session: Session) -> type[Self]:
        """The same sink, which guides through a session."""
        return type(cls.__name__, (cls,), {"session": session})
