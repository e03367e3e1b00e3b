"""Keys: those who have one read, all others do not, and nobody but their owner reads the keys."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread

import pytest
from pydantic import ValidationError

from tactflow.cli.main import main
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import StageError
from tactflow.network.keys import WrongKeysError, make_keys
from tactflow.network.parameters import PublisherParams
from tactflow.network.publisher import Publisher
from tactflow.network.remote_control import RemoteControl
from tactflow.network.subscriber import Subscriber
from tactflow.sinks.zmq import Zmq
from tactflow.tools.fleet.relay import relay
from tactflow.tools.fleet.sinks import beside_others, problems
from tests.clock import PATIENCE
from tests.paths import REPOSITORY

ANY_PORT = "tcp://127.0.0.1:*"
MESSAGE = (
    b'tactflow.main {"schema":"tactflow.frame/1","sensor":"main","seq":1,"t":0.0,'
    b'"contact":null,"flow":null,"markers":null,"skipped":{}}'
)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Keys of a publisher and of a subscriber."""
    return make_keys(tmp_path / "keys", "laptop")


@pytest.fixture
def publisher(folders: tuple[Path, Path]) -> Iterator[str]:
    """An address at which something is published all the time, with keys."""
    publisher, end = Publisher(ANY_PORT, 10, str(folders[0])), Event()

    def publish() -> None:
        while not end.wait(0.01):
            publisher.send(MESSAGE)

    thread = Thread(target=publish)
    thread.start()
    yield publisher.endpoint
    end.set()
    thread.join()
    publisher.close()


def strangers_keys(folder: Path, laptop: Path) -> Path:
    """Keys of somebody whom nobody has admitted, but who knows the publisher's public key."""
    _, stranger = make_keys(folder, "laptop")
    (stranger / "publisher.key").write_bytes((laptop / "publisher.key").read_bytes())
    return stranger


def test_results_are_read_with_the_right_keys_and_not_with_wrong_ones_or_none(
    publisher: str, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    stranger = strangers_keys(tmp_path / "other", folders[1])
    for keys, reason in ((stranger, "does not admit these keys"), (None, "requires keys")):
        subscriber = Subscriber(publisher, timeout=PATIENCE, keys=keys)
        with subscriber, pytest.raises(PermissionError, match=reason):
            subscriber.receive()
    # Nor does a subscriber take anything from a publisher whose key it does not have.
    _, other = make_keys(tmp_path / "third", "laptop")
    with (
        Subscriber(publisher, timeout=PATIENCE, keys=folders[1]) as right,
        Subscriber(publisher, timeout=0.05, keys=other) as wrong,
    ):
        assert [right.receive().seq for _ in range(50)] == [1] * 50
        with pytest.raises((TimeoutError, PermissionError)):
            wrong.receive()


def test_only_commands_with_a_key_are_obeyed(folders: tuple[Path, Path], tmp_path: Path) -> None:
    own, laptop = folders
    stranger = strangers_keys(tmp_path / "other", laptop)
    sink = Zmq(Zmq.Params(endpoint=ANY_PORT, control=ANY_PORT, keys=str(own)))
    sink.open()
    assert sink.control_endpoint is not None
    try:
        for keys, reason in ((stranger, "does not admit these keys"), (None, "requires keys")):
            with RemoteControl(sink.control_endpoint, PATIENCE, keys=keys) as run:
                for _ in range(2):
                    with pytest.raises(PermissionError, match=reason):
                        run.ping()
        with RemoteControl(sink.control_endpoint, PATIENCE, keys=laptop) as run:
            assert run.ping()["ok"]
    finally:
        sink.close()


def test_the_relay_of_several_sensors_requires_keys_and_their_own_processes_need_none(
    folders: tuple[Path, Path],
) -> None:
    sensor, finder = Publisher(ANY_PORT, 10), Publisher(ANY_PORT, 10)
    finder.close()
    together = PublisherParams(endpoint=finder.endpoint, backlog=10, keys=str(folders[0]), linger=0)
    try:
        with (
            relay(together, [sensor.endpoint]),
            Subscriber(finder.endpoint, timeout=PATIENCE, keys=folders[1]) as messages,
        ):
            assert sensor.socket.recv() == b"\x01tactflow."
            sensor.socket.send(MESSAGE)
            assert messages.receive().seq == 1
            with Subscriber(finder.endpoint, timeout=PATIENCE) as stranger, pytest.raises(PermissionError):
                stranger.receive()
    finally:
        sensor.close()


def test_several_sensors_with_different_keys_at_one_address_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "two.yaml"
    text = (REPOSITORY / "pipeline.yaml").read_text(encoding="utf-8").replace("sensor: main", "")
    file.write_text(text + "\nsensors:\n  left: {}\n  right: {sinks: {zmq: {keys: other}}}\n")
    both = {name: load_pipeline(file, sensor=name) for name in ("left", "right")}
    assert any("sinks.zmq.keys: required the same for all" in problem for problem in problems(both))


def test_an_address_that_other_machines_reach_needs_keys_or_an_explicit_word() -> None:
    endpoint = "tcp://*:5556"
    with pytest.raises(ValidationError, match="tactflow keys new"):
        Zmq.Params(endpoint=endpoint)
    assert Zmq.Params(endpoint=endpoint, open_to_all=True).keys is None
    assert Zmq.Params(endpoint=endpoint, keys="keys/publisher").keys == "keys/publisher"
    with pytest.raises(ValidationError, match="commands require keys"):
        Zmq.Params(control=endpoint, open_to_all=True)
    assert Zmq.Params(control=endpoint, control_keys="keys").commanders == "keys"


def test_among_several_sensors_commands_still_require_the_keys_of_all() -> None:
    alone = Zmq.Params(control="tcp://*:5557", keys="mine")
    among = beside_others(alone, Path(), "ipc:///tmp/left")
    assert (among.keys, among.commanders) == (None, "mine")


@pytest.mark.skipif(sys.platform == "win32", reason="permissions are another matter there")
def test_keys_that_other_users_can_read_or_replace_are_refused(folders: tuple[Path, Path]) -> None:
    publisher, subscriber = folders
    files = [path for folder in folders for path in folder.rglob("*")]
    assert len(files) == 6
    assert not any(path.stat().st_mode & 0o077 for path in (*folders, *files))
    for path, mode in (
        (publisher / "publisher.key_secret", 0o640),
        (publisher, 0o770),
        (publisher / "subscribers", 0o770),
        (publisher / "subscribers" / "laptop.key", 0o660),
    ):
        before = path.stat().st_mode
        os.chmod(path, mode)
        with pytest.raises(StageError, match=f"{path}: other users can read or change it; chmod go-rwx"):
            Publisher(ANY_PORT, 1, str(publisher))
        os.chmod(path, before)
    if os.geteuid() == 0:
        os.chown(publisher, 12345, -1)
        with pytest.raises(StageError, match=f"{publisher}: belongs to another user"):
            Publisher(ANY_PORT, 1, str(publisher))
        os.chown(publisher, 0, -1)
    os.chmod(subscriber / "subscriber.key_secret", 0o604)
    with pytest.raises(WrongKeysError, match="other users can read"):
        Subscriber(keys=subscriber)


def test_keys_that_are_missing_or_damaged_are_refused_with_a_hint(folders: tuple[Path, Path]) -> None:
    publisher, subscriber = folders
    with pytest.raises(StageError, match=r"publisher.key_secret: No such file .*; tactflow keys new"):
        Publisher(ANY_PORT, 1, str(subscriber))
    key = publisher / "subscribers" / "laptop.key"
    for text, reason in (
        ('public-key = "short"', "required keys of 40 characters"),
        ("no key", "No public key"),
    ):
        key.write_text(text)
        with pytest.raises(StageError, match=reason):
            Publisher(ANY_PORT, 1, str(publisher))
    key.unlink()
    with pytest.raises(StageError, match="there is no key of a subscriber"):
        Publisher(ANY_PORT, 1, str(publisher))


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
