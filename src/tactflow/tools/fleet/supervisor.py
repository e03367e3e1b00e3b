"""Starts a process for each sensor, forwards signals, and restarts what failed."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from types import FrameType
from typing import IO, NamedTuple, TextIO

from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.files import discard_output
from tactflow.system.signals import INTERRUPTED_EXIT_CODE
from tactflow.tools.fleet.sinks import WatchedSink

FIRST_PAUSE_S = 1.0
"""Pause before the first restart, s; it doubles with each further failure (exponential back-off)."""
MAX_PAUSE_S = 30.0
"""Upper limit of that pause, s."""
MAX_FAILURES = 5
"""Failures in a row after which a sensor is given up."""
GOOD_RUN_S = 30.0
"""A process that ran this long, s, resets the count of failures."""
KILLING_SIGNAL_COUNT = 3
"""Number of the signal that kills the processes; the first lets them finish, the second ends them."""
POLL_SECONDS = 0.05
"""Poll interval, s."""

Process = subprocess.Popen[bytes]


def start_process(command: Sequence[str]) -> Process:
    """Start the process of a sensor, with pipes for its input and output."""
    # In a session of its own, Ctrl-C on the terminal reaches the supervisor alone, which forwards it once.
    # Closing its standard input, as the death of the supervisor does, ends the process.
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


class Member(NamedTuple):
    """A sensor: the command that runs it, and its sinks, which determine how it is restarted."""

    sensor: str
    command: Sequence[str]
    sinks: Sequence[WatchedSink] = ()


class Supervisor:
    """Keeps the processes of several sensors running until each has ended for good.

    Parameters
    ----------
    start : starts a command.
    clock : returns the time, s.
    pause : sleeps, s.
    """

    def __init__(
        self,
        start: Callable[[Sequence[str]], Process] = start_process,
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._start_process = start
        self._clock = clock
        self._pause = pause
        self._signals = 0
        self._refused = False
        self._unwritten = False
        self._readers: list[threading.Thread] = []
        # Separate locks: a blocked reader of results must not hold up messages.
        self._results, self._messages = threading.Lock(), threading.Lock()

    def run(self, members: Sequence[Member]) -> int:
        """Supervise until every process has ended for good.

        Returns the exit code: 0 if all ended well, 130 after a second signal, else that of the first failed
        sensor.
        """
        running = {member.sensor: self._keep_running(member) for member in members}
        codes = dict.fromkeys(running, 0)
        while running:
            for sensor, steps in list(running.items()):
                try:
                    next(steps)
                except StopIteration as end:
                    codes[sensor] = end.value
                    del running[sensor]
            self._pause(POLL_SECONDS)
        for reader in self._readers:
            reader.join(5)
        if self._signals > 1:
            return INTERRUPTED_EXIT_CODE
        return next(filter(None, codes.values()), StageError.exit_code if self._unwritten else 0)

    @property
    def _ends(self) -> int:
        """Number of signals that each process should have received."""
        return max(self._signals, int(self._refused or self._unwritten))

    def _keep_running(self, member: Member) -> Generator[None, None, int]:
        """Run a sensor, again after each failure, until it has ended for good. Returns the exit code.

        Yields while there is nothing to do.
        """
        failures = 0
        while not self._ends:
            started = self._clock()
            code = yield from self._watch(self._start(member))
            if code in (0, ConfigError.exit_code, INTERRUPTED_EXIT_CODE) or self._ends:
                # A wrong command line or file is wrong for the whole run: end the others.
                self._refused |= code == ConfigError.exit_code
                return self._last_code(member, code)
            refused = next((path for sink in member.sinks if (path := sink.refused)), None)
            if code == StageError.exit_code and refused is not None:
                self._say(member, f"failed (exit code {code}); given up, as {refused} may not be replaced")
                return code
            lasted = self._clock() - started
            failures = 1 if lasted > GOOD_RUN_S else failures + 1
            if failures > MAX_FAILURES:
                self._say(member, f"failed {failures} times in a row (exit code {code}); given up")
                return self._last_code(member, code)
            pause = min(FIRST_PAUSE_S * 2 ** (failures - 1), MAX_PAUSE_S)
            self._say(member, f"failed (exit code {code}); starting again in {pause:g} s")
            start_at = self._clock() + pause
            while self._clock() < start_at and not self._ends:
                yield
        return 0

    def _watch(self, process: Process) -> Generator[None, None, int]:
        """Forward signals to a process until it ends. Returns its exit code."""
        sent = 0
        while (code := process.poll()) is None:
            if self._signals >= KILLING_SIGNAL_COUNT:
                process.kill()
            elif sent < self._ends:
                # SIGINT would show a traceback in a process that is still importing. One signal at a time:
                # two at once may be merged.
                process.send_signal(signal.SIGTERM)
                sent += 1
            yield
        if process.stdin is not None:
            process.stdin.close()
        return code

    def _last_code(self, member: Member, code: int) -> int:
        """Exit code of a sensor that is not restarted."""
        if (
            self._ends
            and self._signals < 2
            and code in (-signal.SIGINT, -signal.SIGTERM, INTERRUPTED_EXIT_CODE)
        ):
            # The signal came before the process had installed its handler.
            return 0
        if code < 0:
            self._say(member, f"was ended by signal {-code}")
            return StageError.exit_code
        return code

    def _start(self, member: Member) -> Process:
        """Start the process of a sensor, and the threads that forward its output."""
        kept = [word for sink in member.sinks for text in sink.overrides for word in ("--set", text)]
        process = self._start_process([*member.command, *kept])
        assert process.stdout is not None
        assert process.stderr is not None
        for stream, target, prefix in (
            (process.stdout, sys.stdout, ""),
            (process.stderr, sys.stderr, f"[{member.sensor}] "),
        ):
            reader = threading.Thread(target=self._copy, args=(stream, target, prefix), daemon=True)
            reader.start()
            self._readers.append(reader)
        return process

    def _copy(self, stream: IO[bytes], target: TextIO, prefix: str) -> None:
        """Forward whole lines, so that those of two processes do not mix; they may be any bytes."""
        with stream:
            for line in stream:
                self._write(target, prefix.encode() + line)

    def _say(self, member: Member, text: str) -> None:
        self._write(sys.stderr, f"tactflow: {member.sensor} {text}\n".encode())

    def _write(self, target: TextIO, line: bytes) -> None:
        """Write and flush. If the reader has gone, discard the rest; if the disk is full, end the run."""
        with self._results if target is sys.stdout else self._messages:
            try:
                target.flush()
                target.buffer.write(line)
                target.buffer.flush()
            except OSError as error:
                discard_output(target)
                if target is sys.stdout and not isinstance(error, BrokenPipeError | ConnectionResetError):
                    self._unwritten = True
                    sys.stderr.write(f"tactflow: standard output: {error.strerror}; the run ends\n")

    def count_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Signal handler of the supervisor."""
        # Only count: a process may be starting right now, and would miss a signal sent from here.
        self._signals += 1
