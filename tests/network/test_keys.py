"""Keys: who has one reads, who has none does not, and nobody but their owner reads the keys."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
import zmq
import zmq.auth
from pydantic import ValidationError

from tactflow.cli.main import main
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import StageError
from tactflow.fleet.relay import relay
from tactflow.fleet.sinks import clash_problems
from tactflow.network import bound_socket, connection
from tactflow.network.connection import GREETING, asked_for
from tactflow.network.keys import WrongKeysError, make_keys, subscribers_folder
from tactflow.network.publisher import Publisher
from tactflow.network.remote_control import RemoteControl
from tactflow.network.subscriber import Subscriber
from tactflow.sinks.zmq import Zmq
from tests.clock import PATIENCE, until
from tests.conftest import REPOSITORY

MESSAGE = (
    b'tactflow.main {"schema":"tactflow.frame/1","sensor":"main","seq":1,"t":0.0,'
    b'"contact":null,"flow":null,"markers":null,"skipped":{}}'
)
PUBLISH = f"""
import sys, time
from tactflow.network.publisher import Publisher
publisher = Publisher("tcp://127.0.0.1:*", 10, 32768, sys.argv[1])
print(publisher.endpoint, flush=True)
while True:
    publisher.socket.send({MESSAGE!r})
    time.sleep(0.01)
"""


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Keys of a publisher and of a subscriber."""
    return make_keys(tmp_path / "keys", "laptop")


@pytest.fixture
def publisher(folders: tuple[Path, Path]) -> Iterator[str]:
    """The address of another process that publishes with keys."""
    command = [sys.executable, "-c", PUBLISH, str(folders[0])]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_another_process_reads_with_the_right_keys_and_not_with_wrong_ones_or_none(
    publisher: str, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    with Subscriber(publisher, timeout=PATIENCE, keys=folders[1]) as messages:
        assert messages.receive()["seq"] == 1
    # Keys of somebody else, who knows the publisher's public key.
    _, stranger = make_keys(tmp_path / "other", "laptop")
    (stranger / "publisher.key").write_bytes((folders[1] / "publisher.key").read_bytes())
    for keys, reason in ((stranger, "does not admit these keys"), (None, "asks for keys")):
        subscriber = Subscriber(publisher, timeout=PATIENCE, keys=keys)
        with subscriber, pytest.raises(PermissionError, match=reason):
            subscriber.receive()


def test_a_subscriber_takes_nothing_from_a_publisher_whose_key_it_does_not_have(
    publisher: str, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    _, other = make_keys(tmp_path / "other", "laptop")
    with (
        Subscriber(publisher, timeout=PATIENCE, keys=folders[1]) as right,
        Subscriber(publisher, timeout=PATIENCE, keys=other) as wrong,
    ):
        for _ in range(50):
            right.receive()
        assert not wrong._socket.poll(0)


def test_nobody_is_admitted_while_nothing_answers_for_the_keys(folders: tuple[Path, Path]) -> None:
    publisher = Publisher("tcp://127.0.0.1:*", 10, 32768, str(folders[0]))
    try:
        assert publisher._authenticator is not None
        publisher._authenticator.stop()
        with Subscriber(publisher.endpoint, keys=folders[1]) as messages:
            # Who is let in subscribes at once.
            assert not publisher.socket.poll(1000)
            assert not messages._socket.poll(0)
    finally:
        publisher.close(0)


def test_the_relay_of_several_sensors_asks_for_keys_and_their_own_processes_need_none(
    folders: tuple[Path, Path],
) -> None:
    sensor = Publisher("tcp://127.0.0.1:*", 10, 32768)
    finder = Publisher("tcp://127.0.0.1:*", 10, 32768)
    finder.close(0)
    try:
        with (
            relay(finder.endpoint, [sensor.endpoint], 10, 0.0, str(folders[0])),
            Subscriber(finder.endpoint, timeout=PATIENCE, keys=folders[1]) as messages,
        ):
            assert sensor.socket.recv() == b"\x01tactflow."
            sensor.socket.send(MESSAGE)
            assert messages.receive()["seq"] == 1
            with Subscriber(finder.endpoint, timeout=PATIENCE) as stranger, pytest.raises(PermissionError):
                stranger.receive()
    finally:
        sensor.close(0)


def test_what_a_publisher_asks_for_is_known_before_it_hangs_up(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    for endpoint in ("tcp://127.0.0.1:*", f"ipc://{tmp_path}/results"):
        for keys, mechanism in ((None, "NULL"), (str(folders[0]), "CURVE")):
            opened = Publisher(endpoint, 1, 32768, keys)
            try:
                assert asked_for(opened.endpoint) == mechanism
            finally:
                opened.close(0)
        assert asked_for(opened.endpoint) is None


def test_who_greets_a_byte_at_a_time_is_not_waited_for_beyond_the_time_that_is_left() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def greet_slowly() -> None:
            stream = listener.accept()[0]
            with stream, suppress(OSError):
                # All of it would take five seconds.
                for byte in GREETING + b"\0NULL".ljust(30, b"\0"):
                    time.sleep(0.15)
                    stream.send(bytes([byte]))

        slow = threading.Thread(target=greet_slowly)
        slow.start()
        assert asked_for(f"tcp://127.0.0.1:{listener.getsockname()[1]}", 0.3) is None
        slow.join()


def test_who_hangs_up_is_asked_why_within_the_time_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[float] = []

    def asked_for_keys(_endpoint: str, seconds: float) -> str:
        given.append(seconds)
        return "CURVE"

    monkeypatch.setattr(connection, "PATIENCE", 2 * PATIENCE)
    monkeypatch.setattr(connection, "asked_for", asked_for_keys)
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def hang_up() -> None:
            with suppress(OSError):
                while True:
                    listener.accept()[0].close()

        threading.Thread(target=hang_up, daemon=True).start()
        endpoint = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        with RemoteControl(endpoint, PATIENCE) as run, pytest.raises(PermissionError, match="asks for keys"):
            run.ping()
        listener.shutdown(socket.SHUT_RDWR)
    (seconds,) = given
    assert seconds <= PATIENCE


def test_several_sensors_with_different_keys_at_one_address_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "two.yaml"
    text = (REPOSITORY / "pipeline.yaml").read_text(encoding="utf-8").replace("sensor: main", "")
    file.write_text(text + "\nsensors:\n  left: {}\n  right: {sinks: {zmq: {keys: other}}}\n")
    both = {name: load_pipeline(file, sensor=name) for name in ("left", "right")}
    assert any("sinks.zmq.keys: required the same for all" in problem for problem in clash_problems(both))


@pytest.mark.parametrize("endpoint", ["tcp://*:5556", "tcp://0.0.0.0:5556", "tcp://eth0:1", "tcp://[::]:1"])
def test_an_address_that_others_reach_needs_keys_or_a_word(endpoint: str) -> None:
    with pytest.raises(ValidationError, match="tactflow keys new"):
        Zmq.Params(endpoint=endpoint)
    assert Zmq.Params(endpoint=endpoint, open_to_all=True).keys is None
    assert Zmq.Params(endpoint=endpoint, keys="keys/publisher").keys == "keys/publisher"


@pytest.mark.skipif(sys.platform == "win32", reason="permissions are another matter there")
def test_only_their_owner_can_read_keys_and_others_are_refused(folders: tuple[Path, Path]) -> None:
    publisher, subscriber = folders
    secrets = (publisher / "publisher.key_secret", subscriber / "subscriber.key_secret")
    assert [file.stat().st_mode & 0o777 for file in (publisher, subscriber, *secrets)] == [
        *(0o700, 0o700, 0o600, 0o600)
    ]
    for file in secrets:
        os.chmod(file, 0o640)
    with pytest.raises(StageError, match=r"others may read it; chmod 600"):
        Publisher("tcp://127.0.0.1:*", 1, 32768, str(publisher))
    with pytest.raises(WrongKeysError, match=r"others may read it; chmod 600"):
        Subscriber(keys=subscriber)


@pytest.mark.skipif(sys.platform == "win32", reason="permissions are another matter there")
@pytest.mark.parametrize("place", ["", "subscribers", "subscribers/laptop.key"])
def test_who_may_read_is_not_for_others_to_say(folders: tuple[Path, Path], place: str) -> None:
    os.chmod(folders[0] / place, 0o770)
    with pytest.raises(StageError, match=r"others may write to it; chmod go-w"):
        Publisher("tcp://127.0.0.1:*", 1, 32768, str(folders[0]))


def test_a_ctrl_c_leaves_no_half_of_the_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create = zmq.auth.create_certificates

    def interrupted(*args: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return create(*args)

    monkeypatch.setattr(zmq.auth, "create_certificates", interrupted)
    assert main(["keys", "new", "laptop", "--folder", str(tmp_path)]) == 130
    subscribers_folder(tmp_path / "publisher")
    with Subscriber(keys=tmp_path / "laptop"):
        pass


def test_keys_that_are_missing_or_damaged_are_refused_with_a_hint(folders: tuple[Path, Path]) -> None:
    publisher, subscriber = folders
    with pytest.raises(StageError, match=r"publisher.key_secret: there is no such file; tactflow keys new"):
        Publisher("tcp://127.0.0.1:*", 1, 32768, str(subscriber))
    (publisher / "subscribers" / "laptop.key").write_text('public-key = "short"')
    with pytest.raises(StageError, match=r"laptop.key: required keys of 40 letters"):
        Publisher("tcp://127.0.0.1:*", 1, 32768, str(publisher))
    (publisher / "subscribers" / "laptop.key").unlink()
    with pytest.raises(StageError, match=r"there is no key of a subscriber"):
        Publisher("tcp://127.0.0.1:*", 1, 32768, str(publisher))


def test_the_command_keeps_keys_that_are_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "keys"
    assert main(["keys", "new", "laptop", "--folder", str(folder)]) == 0
    assert f"--set sinks.zmq.keys={folder / 'publisher'}" in capsys.readouterr().out
    before = (folder / "publisher" / "publisher.key_secret").read_bytes()
    assert main(["keys", "new", "--folder", str(folder), "phone"]) == 0
    assert (folder / "publisher" / "publisher.key_secret").read_bytes() == before
    assert main(["keys", "new", "laptop", "--folder", str(folder)]) == 2
    assert main(["keys", "new", "../x", "--folder", str(folder)]) == 2
    assert sorted(path.name for path in folder.iterdir()) == ["laptop", "phone", "publisher"]


def test_the_relay_delivers_the_last_messages_to_a_slow_subscriber_as_long_as_it_is_told_to() -> None:
    sensor = Publisher("tcp://127.0.0.1:*", 100, 1 << 20)
    finder = Publisher("tcp://127.0.0.1:*", 1, 32768)
    finder.close(0)
    closing = ExitStack()
    closing.enter_context(relay(finder.endpoint, [sensor.endpoint], 100, 60.0))
    with zmq.Context() as context, context.socket(zmq.SUB) as slow:
        slow.linger, slow.rcvtimeo, slow.rcvhwm, slow.rcvbuf = 0, round(PATIENCE * 1000), 1, 4096
        slow.subscribe("tactflow.")
        slow.connect(finder.endpoint)
        assert sensor.socket.recv() == b"\x01tactflow."
        # More than all buffers on the way hold.
        for number in range(50):
            sensor.socket.send(b"tactflow.main %d " % number + bytes(200_000))

        def end() -> None:
            sensor.close(60.0)
            closing.close()

        ended = threading.Thread(target=end)
        ended.start()
        ended.join(1.0)
        assert [int(slow.recv().split(b" ")[1]) for _ in range(50)] == list(range(50))
        ended.join()


def test_the_relay_ends_a_flood_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Publisher("tcp://127.0.0.1:*", 10, 32768)
    finder = Publisher("tcp://127.0.0.1:*", 10, 32768)
    finder.close(0)
    try:
        with (
            relay(finder.endpoint, [sensor.endpoint], 10, 0.0),
            Subscriber(finder.endpoint, timeout=PATIENCE) as messages,
        ):
            assert sensor.socket.recv() == b"\x01tactflow."
            left = [0]
            monkeypatch.setattr(bound_socket, "files_left", lambda: left.pop() if left else 1000)
            # It lets go of the sensors as well, and comes again with those who come again.
            assert sensor.socket.recv() == b"\x00tactflow."
            until(lambda: messages._socket.poll(1) or sensor.socket.poll(1))
            assert sensor.socket.recv() == b"\x01tactflow."
            sensor.socket.send(MESSAGE)
            assert messages.receive()["seq"] == 1
    finally:
        sensor.close(0)
