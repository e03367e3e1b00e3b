"""Passwords and tokens are left out, however they are written."""

from __future__ import annotations

import pytest

from tactflow.cli.main import main
from tactflow.system.redaction import public_address, without_secrets

SECRET = "a-secret-of-some-length"


@pytest.mark.parametrize(
    "text",
    [
        f"sinks: {{view: {{token: {SECRET}}}}}",
        f"sinks:\n  view:\n    token: >-\n      {SECRET}\n",
        f"mine: &t {SECRET}\nsinks: {{view: {{token: *t}}}}",
        f"sinks: {{view: {{token: &t '{SECRET}'}}}}",
        f"sensors: {{left: {{sinks.view.token: {SECRET}}}}}",
        f"stages: {{capture: {{source: 'rtsp://me:{SECRET}@camera/1'}}}}",
        f"stages: {{capture: {{source: 'rtsp://me:p@{SECRET}@camera/1'}}}}",
        *(
            f"stages: {{capture: {{source: 'http://camera/{path}'}}}}"
            for path in (
                f"video?channel=1&PWD={SECRET}",
                f"video?access_token={SECRET}",
                f"video?credential={SECRET}",
                f"video?sig={SECRET}",
                f"video#token={SECRET}",
                f"video;password={SECRET}",
                f"user=admin_password={SECRET}_channel=1.sdp",
                f"{SECRET}/stream",
            )
        ),
        f"stages: {{capture: {{source: 'rtsp://me:pass/{SECRET}@camera/1'}}}}",
        f"stages: {{capture: {{source: 'rtsp://{SECRET}/word@camera/1'}}}}",
        f'stages: {{capture: {{source: "rtsp://me:it\'s{SECRET}@camera/1"}}}}',
    ],
)
def test_a_pipeline_is_handed_on_without_its_secrets(text: str) -> None:
    public = without_secrets(text)
    assert SECRET not in public
    assert public.partition(":")[0] == text.partition(":")[0]


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


def test_what_is_no_secret_stays() -> None:
    text = "stages: {capture: {source: 'http://camera:81'}}\nsinks: {view: {token: null, path: 'ipc:///tmp/a'}}\n"
    assert without_secrets(text) == text
    assert public_address("/data/press@2x.avi") == "/data/press@2x.avi"
    hidden = public_address("no stream at http://camera/1: no answer")
    assert public_address(hidden) == hidden == "no stream at http://camera/...: no answer"
