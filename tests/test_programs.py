"""The programs in examples/ do what they say."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
import threading
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tactflow.engine.frame import Frame, Tick
from tactflow.sinks.zmq import Zmq
from tactflow.vision.types import Contact, Slip
from tests.clock import LOOK_SECONDS
from tests.messages import Results, result_of
from tests.paths import REPOSITORY

EXAMPLES = REPOSITORY / "examples"
CONTACT = Contact(200.0, (30.0, 20.0), 30.0, -0.577, np.array([[25.0, 15], [35, 15], [30, 28]]), None)
SEQ = count()


def test_the_gripper_closes_until_touch_holds_and_tightens_while_it_slips() -> None:
    sink = Zmq(Zmq.Params(endpoint="tcp://127.0.0.1:*"))
    sink.open()
    command = [sys.executable, str(EXAMPLES / "grasp_until_touch.py"), sink.endpoint]
    states = [
        (Results(), "closing"),
        (Results(contact=CONTACT, slip=Slip(False, 1.0)), "holding"),
        (Results(contact=CONTACT, slip=Slip(True, 0.0)), "slips, tightening"),
        (Results(contact=CONTACT), "holding"),
    ]
    widths = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as example:
        assert example.stdout is not None
        try:
            for results, words in states:
                line = said(example.stdout, sink, results)
                assert line.rstrip().endswith(words)
                widths.append(float(line.split()[2]))
        finally:
            example.terminate()
    sink.close()
    closing, holding, tightening, held = widths
    assert closing >= holding > tightening >= held


@pytest.mark.parametrize(
    "example", sorted((EXAMPLES / "gallery").glob("plot_*.py")), ids=lambda path: path.stem
)
def test_every_example_of_the_gallery_runs(example: Path) -> None:
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    runpy.run_path(str(example))
    assert pyplot.get_fignums()
    pyplot.close("all")


def said(stdout: Any, sink: Zmq, results: Results) -> str:
    """The next line of the example while these are the results."""
    answer: list[str] = []
    reader = threading.Thread(target=lambda: answer.append(stdout.readline()))
    reader.start()
    while reader.is_alive():
        seq = next(SEQ)
        sink.write(result_of(Tick(Frame("main", seq, seq / 60, np.zeros((40, 60, 3), np.uint8))), results))
        reader.join(LOOK_SECONDS)
    return answer[0]


def test_every_cell_of_the_notebook_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    notebook = json.loads((EXAMPLES / "notebook.ipynb").read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    # In Jupyter there is IPython; here, what it would show is looked at.
    shown: list[bytes] = []
    display = ModuleType("IPython.display")
    display.__dict__.update(Image=lambda data: data, display=shown.append)
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert not cell["outputs"]
            exec("".join(cell["source"]), names)
    (picture,) = shown
    assert picture[:2] == b"\xff\xd8"
    out = capsys.readouterr().out
    assert "60 frames, touched in " in out
    assert "80 dots of radius" in out
