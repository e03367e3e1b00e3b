"""Starts a process for each sensor, forwards signals, and restarts what failed."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import IO, TextIO

from tactflow.engine.errors import ConfigError, StageError
from tactflow.fleet.heartbeat import Watchdog
from tactflow.fleet.sinks import WatchedSink
from tactflow.system.files import discard_output
from tactflow.system.signals import INTERRUPTED

FIRST_PAUSE = 1.0
"""Pause before the first restart, s; it doubles with each further failure (exponential back-off)."""
LONGEST_PAUSE = 30.0
"""Upper limit of that pause, s."""
GIVE_UP_AFTER = 5
"""Failures in a row after which a sensor is given up."""
GOOD_RUN = 30.0
"""A process that ran this long, s, resets the count of failures."""
KILL_AT = 3
"""Number of the signal that kills the processes; the first lets them finish, the second ends them."""
LOOK_EVERY = 0.05
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


@dataclass(slots=True)
class Member:
    """One sensor's process and its history.

    command : runs the sensor. watchdog : of its heartbeat. sinks : what they have written decides with which
    parameters the sensor is restarted.
    process : the running one; None between two. started, start_at : when it was started, and when it may be
    restarted, s. signals_sent : signals forwarded to the process; KILL_AT if it was killed. failures : in a
    row. code : final exit code. readers : threads that forward its output.
    """

    sensor: str
    command: Sequence[str]
    watchdog: Watchdog
    sinks: Sequence[WatchedSink] = ()
    process: Process | None = None
    started: float = 0.0
    start_at: float = 0.0
    signals_sent: int = 0
    failures: int = 0
    code: int | None = None
    readers: list[threading.Thread] = field(default_factory=list[threading.Thread])


class Supervisor:
    """Keeps the processes of several sensors running until each has ended for good.

    start : starts a command. clock : returns the time, s. pause : sleeps, s.
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
        # Separate locks: a blocked reader of results must not hold up messages.
        self._results, self._messages = threading.Lock(), threading.Lock()

    def run(self, members: Sequence[Member]) -> int:
        """Supervise until every process has ended for good.

        Returns
        -------
        The exit code: 0 if all ended well, 130 after a second signal, else that of the first failed sensor.
        """
        while any(member.code is None for member in members):
            for member in members:
                self._attend(member)
            self._pause(LOOK_EVERY)
        for member in members:
            for reader in member.readers:
                reader.join(5)
        if self._signals > 1:
            return INTERRUPTED
        return next((m.code for m in members if m.code), StageError.exit_code if self._unwritten else 0)

    @property
    def _ends(self) -> int:
        """Number of signals that each process should have received."""
        return max(self._signals, int(self._refused or self._unwritten))

    def _attend(self, member: Member) -> None:
        if member.code is not None:
            return
        if member.process is None:
            if self._ends:
                member.code = 0
            elif self._clock() >= member.start_at:
                self._start(member)
            return
        code = member.process.poll()
        if code is None:
            if self._signals >= KILL_AT and member.signals_sent < KILL_AT:
                member.signals_sent = KILL_AT
                member.process.kill()
            elif member.signals_sent < self._ends:
                # SIGINT would show a traceback in a process that is still importing. One signal at a time:
                # two at once may be merged.
                member.process.send_signal(signal.SIGTERM)
                member.signals_sent += 1
            self._look_for_life(member, member.process)
            return
        if member.process.stdin is not None:
            member.process.stdin.close()
        member.process = None
        if code in (0, ConfigError.exit_code, INTERRUPTED) or self._ends:
            member.code = self._last_code(member, code)
            # A wrong command line or file is wrong for the whole run: end the others.
            self._refused |= code == ConfigError.exit_code
        else:
            self._start_again(member, code)

    def _look_for_life(self, member: Member, process: Process) -> None:
        """Kill a process whose heartbeat has stopped."""
        if member.signals_sent >= KILL_AT:
            return
        if self._results.locked() or self._messages.locked():
            # It may be blocked by our own reader.
            member.watchdog.skip(self._clock())
        elif member.watchdog.expired(self._clock()):
            self._say(member, f"has hung for {member.watchdog.timeout:g} s and is killed")
            member.signals_sent = KILL_AT
            process.kill()

    def _last_code(self, member: Member, code: int) -> int:
        """Exit code of a sensor that is not restarted."""
        if self._ends and self._signals < 2 and code in (-signal.SIGINT, -signal.SIGTERM, INTERRUPTED):
            # The signal came before the process had installed its handler.
            return 0
        if code < 0:
            self._say(member, f"was ended by signal {-code}")
            return StageError.exit_code
        return code

    def _start_again(self, member: Member, code: int) -> None:
        """Schedule the restart after a failure, or give up."""
        refused = next((path for sink in member.sinks if (path := sink.refused)), None)
        if code == StageError.exit_code and refused is not None:
            self._say(member, f"failed (exit code {code}); given up, as {refused} may not be replaced")
            member.code = code
            return
        lasted = self._clock() - member.started - member.watchdog.silent
        member.failures = 1 if lasted > GOOD_RUN else member.failures + 1
        if member.failures > GIVE_UP_AFTER:
            self._say(member, f"failed {member.failures} times in a row (exit code {code}); given up")
            member.code = self._last_code(member, code)
            return
        pause = min(FIRST_PAUSE * 2 ** (member.failures - 1), LONGEST_PAUSE)
        member.start_at = self._clock() + pause
        self._say(member, f"failed (exit code {code}); starting again in {pause:g} s")

    def _start(self, member: Member) -> None:
        kept = [text for sink in member.sinks for text in sink.overrides]
        member.process = self._start_process(
            [*member.command, *(word for t in kept for word in ("--set", t))]
        )
        member.started, member.signals_sent = self._clock(), 0
        member.watchdog.start(member.started)
        assert member.process.stdout is not None
        assert member.process.stderr is not None
        for stream, target, prefix in (
            (member.process.stdout, sys.stdout, ""),
            (member.process.stderr, sys.stderr, f"[{member.sensor}] "),
        ):
            reader = threading.Thread(target=self._copy, args=(stream, target, prefix), daemon=True)
            reader.start()
            member.readers.append(reader)

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
