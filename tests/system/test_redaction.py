"""Passwords and tokens are left out, however they are written."""

from __future__ import annotations

import pytest

from tactflow.cli.main import main
from tactflow.system.redaction import public_address, without_secrets

SECRET = "a-secret-of-some-length"


@pytest.mark.parametrize(
    "source",
    [
        f"rtsp://me:{SECRET}@camera/1",
        f"rtsp://me:p@{SECRET}@camera/1",
        f"http://camera/video?channel=1&PWD={SECRET}",
        f"http://camera/video#token={SECRET}",
        f"http://camera/video;password={SECRET}",
        f"http://camera/user=admin_password={SECRET}_channel=1.sdp",
        f"http://camera/{SECRET}/stream",
        f"rtsp://me:pass/{SECRET}@camera/1",
        f"rtsp://{SECRET}/word@camera/1",
        f"rtsp://me:it's{SECRET}@camera/1",
    ],
)
def test_settings_are_handed_on_without_their_secrets(source: str) -> None:
    settings = {"stages": {"capture": {"source": source}}, "sinks": {"view": {"token": SECRET}}}
    public = without_secrets(settings)
    assert SECRET not in str(public)
    assert list(public) == ["stages", "sinks"]


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--source", f"ftp://me:{SECRET}@camera/1"],
        ["run", "--set", f"stages.capture.source=ftp://me:{SECRET}@camera/1"],
        ["run", "--set", f"sinks.jsonl={{token: {SECRET}}}"],
        ["run", "--source", f"rtsp://127.0.0.1:{SECRET}/word@camera/1"],
        ["run", f"rtsp://me:{SECRET}@camera/1"],
        ["run", "one.yaml", f"rtsp://me:{SECRET}@camera/1"],
        ["repair", f"http://camera/{SECRET}"],
        ["batch", f"rtsp://me:{SECRET}@camera/1", "--out", "unused"],
    ],
)
def test_no_error_message_repeats_a_secret_of_the_command_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) in (2, 4)
    said = capsys.readouterr().err
    assert SECRET not in said
    assert said


def test_other_settings_are_kept() -> None:
    settings = {"source": "http://camera:81", "token": None, "path": "ipc:///tmp/a", "sizes": [1, "a"]}
    assert without_secrets(settings) == settings
    assert public_address("/data/press@2x.avi") == "/data/press@2x.avi"
    hidden = public_address("no stream at http://camera/1: no answer")
    assert public_address(hidden) == hidden == "no stream at http://camera/...: no answer"
