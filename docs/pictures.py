"""Create the pictures of README.md and view.md: results.jpg, view-dark.jpg, view-phone.jpg.

It calibrates the simulated sensor, draws its results with the stage `visualize`, and takes screenshots of the
live page in Chromium. It needs the packages of the browser tests, and an idle machine because the page shows
latency. It takes two minutes.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Browser, sync_playwright

import tactflow

DOCS = Path(__file__).resolve().parent
PITCH: Final = 1.724
BALL_RADIUS: Final = 2.375
"""Pitch of the simulated dots and radius of the ball, mm, at 0.025 mm per raw pixel."""
GAUGED: Final = "twist?frames=800&seed=3"
"""Scene for the force calibration."""
WATCHED: Final = "sim:twist?frames=100000"
"""Source of the page."""
SHOWN: Final = {"press": (30, 50), "cable": (30, 50), "slide": (40, 60)}
"""Scene -> range of frames, of which the deepest is drawn."""
DEEPEST: Final = 0.8
"""Height of the lightest colour, mm."""
QUALITY: Final = 82
"""JPEG quality of all pictures."""
FULL_SECONDS: Final = 11
"""Seconds until the plots of the page are full."""
DEEP: Final = "() => parseFloat(document.getElementById('value-depth').textContent) > 0.2"


def main() -> None:
    """Create results.jpg and the screenshots."""
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / "main.yaml"
        scale = ("--pitch", str(PITCH), "--ball-radius", str(BALL_RADIUS), "--out", str(calibration))
        _tactflow("calibrate", "--from", "sim:ball?frames=600", *scale)
        gauge = str(Path(folder) / "gauge.csv")
        _tactflow("sim", GAUGED, "--truth", gauge)
        force = ("calibrate", "force", str(calibration), "--from", f"sim:{GAUGED}", "--csv", gauge)
        _tactflow(*force)
        drawn = [_drawn(scene, calibration, *frames) for scene, frames in SHOWN.items()]
        cv2.imwrite(str(DOCS / "results.jpg"), np.hstack(drawn), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        _pages(calibration)


def _drawn(scene: str, calibration: Path, first: int, last: int) -> NDArray[np.uint8]:
    """The deepest frame of a range with its results, and its height map below."""
    settings = {"calibration": str(calibration)}
    results = tactflow.stream(source=f"sim:{scene}", settings=settings, max_frames=last, images=True)
    r = max(
        (r for r in results if r.seq >= first and r.depth is not None),
        key=lambda r: 0.0 if r.depth is None else r.depth.greatest,
    )
    return np.vstack([tactflow.draw(r), tactflow.draw(r, view="depth", deepest=DEEPEST)])


def _pages(calibration: Path) -> None:
    run = _started(
        *("run", "--realtime", "--quiet", "--source", WATCHED),
        *("--set", "sinks={view: {port: 0, max_fps: 10}}", "--set", f"calibration={calibration}"),
    )
    try:
        assert run.stderr is not None
        url = next(found[1] for line in run.stderr if (found := re.search(r"view: (http://\S+)", line)))
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=shutil.which("chromium") or shutil.which("chromium-browser"),
                args=["--no-sandbox"] if os.geteuid() == 0 else [],
            )
            _page(browser, url, "view-dark.jpg", surface=True, viewport={"width": 1400, "height": 900})
            phone = {"device_scale_factor": 2, "is_mobile": True, "has_touch": True}
            _page(
                browser, url, "view-phone.jpg", surface=False, viewport={"width": 390, "height": 844}, **phone
            )
            browser.close()
    finally:
        run.terminate()
        run.wait()


def _page(browser: Browser, url: str, name: str, *, surface: bool, **options: Any) -> None:
    """Take a screenshot of the page during contact, with full plots."""
    page = browser.new_context(color_scheme="dark", **options).new_page()
    page.goto(url)
    if surface:
        page.wait_for_selector("#layer-surface:visible")
        page.click("#layer-surface")
    page.wait_for_timeout(1000 * FULL_SECONDS)
    page.wait_for_function(DEEP)
    page.click("#pause")
    page.wait_for_timeout(1000)
    page.screenshot(path=DOCS / name, type="jpeg", quality=QUALITY)
    page.click("#pause")
    page.close()


def _started(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "tactflow", *words], stderr=subprocess.PIPE, text=True)


def _tactflow(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "tactflow", *words], check=True)


if __name__ == "__main__":
    main()
