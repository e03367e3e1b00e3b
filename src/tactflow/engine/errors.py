"""Every error tactflow raises on purpose.

TactflowError
+-- ConfigError        the command line or the pipeline file is wrong (exit 2)
+-- StageError         a stage or a sink failed (exit 3)
+-- SourceError        the source failed or could not be opened (exit 4)
"""

from __future__ import annotations


class TactflowError(Exception):
    """An error with a message for the user: what is wrong, what was expected, what to try.

    >>> issubclass(ConfigError, TactflowError), SourceError.exit_code
    (True, 4)
    """

    exit_code = 3


class ConfigError(TactflowError):
    """The command line or the pipeline file is wrong; nothing was started.

    mistakes : each a text for the user; all are reported at once.

    >>> ConfigError("pipeline.yaml:3:1  colour: unknown key").mistakes
    ('pipeline.yaml:3:1  colour: unknown key',)
    """

    exit_code = 2

    def __init__(self, *mistakes: str) -> None:
        title = [f"{len(mistakes)} mistakes"] if len(mistakes) > 1 else []
        super().__init__("\n".join([*title, *mistakes]))
        self.mistakes = mistakes


class StageError(TactflowError):
    """A stage or a sink failed."""

    exit_code = 3


class SourceError(TactflowError):
    """The source failed or could not be opened."""

    exit_code = 4
