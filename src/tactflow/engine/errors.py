"""The exceptions of tactflow.

TactflowError
+-- ConfigError        the command line or the pipeline file is wrong (exit 2)
+-- StageError         a stage or a sink failed (exit 3)
+-- SourceError        the source failed or could not be opened (exit 4)
"""

from __future__ import annotations


class TactflowError(Exception):
    """An error whose message states what is wrong, what was expected and a remedy.

    >>> issubclass(ConfigError, TactflowError), SourceError.exit_code
    (True, 4)
    """

    exit_code = 3


class ConfigError(TactflowError):
    """An error in the command line or the pipeline file; nothing was started.

    Attributes
    ----------
    mistakes : messages, all reported at once.

    Examples
    --------
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
