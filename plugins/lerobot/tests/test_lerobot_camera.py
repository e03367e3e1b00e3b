"""`lerobot_camera_tactflow`, in LeRobot's own hands."""

from __future__ import annotations

import json

from plugins.lerobot.tests.lerobot_env import needs_lerobot, run_with_lerobot

START = """
import json, sys
import numpy as np
import draccus
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.utils.import_utils import register_third_party_plugins
import tactflow

register_third_party_plugins()

def make(**outputs):
    typed = {name: {"type": "tactflow", **fields} for name, fields in outputs.items()}
    configs = {name: draccus.decode(CameraConfig, fields) for name, fields in typed.items()}
    return make_cameras_from_configs(configs)

def failure(call, *arguments):
    try:
        call(*arguments)
    except Exception as error:
        return f"{type(error).__name__}: {error}"

def results(source, **settings):
    return list(tactflow.stream(source=source, settings={"sinks": {}, **settings}, images=True))
"""

OUTPUTS = """
source = {"source": "sim:press?frames=20&noise=0", "realtime": False}
cameras = make(gel=source, swapped=source | {"color_mode": "bgr"}, markers=source | {"output": "markers"},
    change=source | {"output": "difference"})
for camera in cameras.values():
    camera.connect()
shapes = {name: [camera.height, camera.width] for name, camera in cameras.items()}
equal, changes = [], []
for result in results(source["source"]):
    frame = {name: camera.async_read(60_000) for name, camera in cameras.items()}
    markers = result.markers
    equal += [
        np.array_equal(frame["gel"][:, :, ::-1], result.image),
        np.array_equal(frame["swapped"], result.image),
        np.array_equal(frame["markers"][:, :2], markers.origin.astype(np.float32)),
        np.array_equal(frame["markers"][:, 2:4], markers.displacement.astype(np.float32)),
        np.array_equal(frame["markers"][:, 4], markers.status),
        len({camera.result.t for camera in cameras.values()} | {result.t}) == 1,
    ]
    changes.append([result.contact is not None, float(abs(frame["change"] - 128.0).mean())])
latest = cameras["gel"].read_latest(10**9)
ended = failure(cameras["gel"].async_read, 60_000)
for camera in cameras.values():
    camera.disconnect()
print(json.dumps([shapes, equal, changes, ended, np.array_equal(latest, frame["gel"])]))
"""

ERRORS = """
source = {"source": "sim:press?frames=3", "realtime": False}
cameras = make(gel=source, markers=source | {"output": "markers"}, missing={"source": "no-such.avi"},
    wide=source | {"width": 320}, depth=source | {"output": "depth"})
gel, markers = cameras["gel"], cameras["markers"]
said = [failure(gel.async_read), failure(gel.disconnect)]
gel.connect()
markers.connect()
said += [failure(gel.connect)]
gel.read()
# The next frame waits until the other camera has read this one.
said += [failure(gel.async_read, 20)]
markers.read()
gel.read()
gel.disconnect()
markers.disconnect()
said += [failure(gel.read), failure(cameras["missing"].connect), failure(cameras["wide"].connect),
    failure(cameras["depth"].connect), failure(lambda: make(odd=source | {"output": "smell"})),
    failure(lambda: make(odd=source | {"depth_mm": 0}))]
print(json.dumps(said))
"""


@needs_lerobot
def test_outputs_are_what_tactflow_found_in_the_same_frame() -> None:
    shapes, equal, changes, ended, latest_is_last = json.loads(run_with_lerobot(START + OUTPUTS))
    picture, (markers, columns) = [400, 300], shapes.pop("markers")
    assert shapes == dict.fromkeys(("gel", "swapped", "change"), picture)
    assert (markers, columns) == (80, 5)
    assert len(equal) == 6 * 20
    assert all(equal)
    assert latest_is_last
    touched = [change for touching, change in changes if touching]
    assert min(touched) > max(change for touching, change in changes[:2] if not touching)
    assert ended.startswith("RuntimeError: TactflowCamera(sim:press")
    assert ended.endswith("read thread is not running: the source has ended")


@needs_lerobot
def test_errors_are_those_that_lerobot_expects() -> None:
    said = json.loads(run_with_lerobot(START + ERRORS))
    camera = "TactflowCamera(sim:press?frames=3, "
    failed = "ConnectionError: Failed to connect to "
    expected = [
        "DeviceNotConnectedError: TactflowCamera is not connected",
        f"DeviceNotConnectedError: {camera}image) not connected",
        "DeviceAlreadyConnectedError: TactflowCamera is already connected",
        f"TimeoutError: {camera}image) async_read timeout after 20ms",
        "DeviceNotConnectedError: TactflowCamera is not connected",
        f"{failed}TactflowCamera(no-such.avi, image): capture (source no-such.avi): no-such.avi: no such",
        f"{failed}{camera}image): width=320 is configured, but the pipeline gives 300",
        f"{failed}{camera}depth): the pipeline gives no scale",
        "DecodingError:",
        "ParsingError:",
    ]
    for given, beginning in zip(said, expected, strict=True):
        assert str(given).startswith(beginning), (given, beginning)
