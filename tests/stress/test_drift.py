"""Over many presses and releases nothing creeps; and the long stress says so when something does."""

from __future__ import annotations

import mmap
import sys
from pathlib import Path

import numpy as np
import pytest

from tactflow.bench.stress import LARGEST_GROWTH, Block, Drift, measure_drift, memory_mb, memory_of
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError
from tests.stress.builders import DIFFERENCES, TRACKERS, Image, gel

REPOSITORY = Path(__file__).resolve().parents[2]


def noisy(picture: Image, random: np.random.Generator) -> Image:
    return np.clip(np.rint(picture + random.normal(0, 1, picture.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("method", TRACKERS)
def test_marker_errors_do_not_grow_with_the_number_of_presses(method: str) -> None:
    pictures = gel(noise=0.0)
    random = np.random.default_rng(0)
    tracker = TRACKERS[method](pictures.reference)
    wanted = pictures.position - pictures.origin
    errors = []
    for _ in range(60):
        for picture, truth in ((pictures.touched, wanted), (pictures.reference, 0 * wanted)):
            moved = tracker.track(noisy(picture, random))
            away = np.hypot(*(moved.origin[:, None] - pictures.origin[None]).transpose(2, 0, 1))
            error = moved.displacement - truth[away.argmin(axis=1)]
            errors.append(float(np.sqrt((error**2).sum(axis=1).mean())))
    early, late = np.array(errors[:40]), np.array(errors[-40:])
    # Independent noise: the difference of two means of 40 is below four of its standard errors.
    chance = np.sqrt(early.var() / 40 + late.var() / 40)
    assert late.mean() <= early.mean() + 4 * chance


@pytest.mark.parametrize("method", DIFFERENCES)
def test_a_detector_ends_every_one_of_many_contacts(method: str) -> None:
    pictures = gel(dots=False, noise=0.0)
    random = np.random.default_rng(0)
    detector = DIFFERENCES[method]()
    detector.add_reference(noisy(pictures.reference, random))
    for _ in range(60):
        assert detector.detect(noisy(pictures.touched, random)).touching
        assert not detector.detect(noisy(pictures.reference, random)).touching


def test_the_whole_pipeline_does_not_creep_in_a_short_run() -> None:
    pipeline = load_pipeline(REPOSITORY / "pipeline.yaml")
    done: list[tuple[int, int]] = []
    drift = measure_drift(pipeline, 480, lambda _what, now, total: done.append((now, total)), blocks=2)
    assert done[-1] == (480, 480)
    assert sum(block.frames for block in drift.blocks) == 480
    # The tracker's error on this scene, noise 2: measured 0.008 px.
    assert all(0 < block.error < 0.02 for block in drift.blocks)
    # A clock must not decide here; the others must hold.
    assert [words for words in drift.complaints() if "times as long" not in words] == []
    assert len(list(drift.rows())) == 2


def test_a_pipeline_without_markers_cannot_be_stressed() -> None:
    with pytest.raises(ConfigError, match="required a pipeline that gives markers"):
        measure_drift(load_pipeline(REPOSITORY / "pipelines" / "markerless.yaml"), 1, blocks=1)


def steady(**changed: float) -> Drift:
    """Ten equal blocks, the last one changed."""
    blocks = [Block(100, [0.010, 0.011, 0.009, 0.010], 0.0, 5.0, 200.0) for _ in range(10)]
    for name, value in changed.items():
        setattr(blocks[-1], name, [value] * 4 if name == "errors" else value)
    return Drift(blocks)


def test_nothing_crept_where_all_blocks_are_equal() -> None:
    assert steady().complaints() == []
    assert steady(errors=0.005, cpu_ms=1.0, memory_mb=100.0).complaints() == []


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"errors": 0.02}, "marker error rose from 0.0100 to 0.0200 px"),
        ({"lost": 0.05}, "lost markers rose from 0.0 to 5.0 %"),
        ({"memory_mb": 200 + LARGEST_GROWTH + 1}, "memory grew by 17.0 MB"),
        ({"cpu_ms": 6.5}, "1.30 times as long"),
    ],
)
def test_what_crept_is_named_with_numbers(changed: dict[str, float], words: str) -> None:
    complaints = steady(**changed).complaints()
    assert len(complaints) == 1
    assert words in complaints[0]


@pytest.mark.skipif(sys.platform != "linux", reason="what a process holds now is told by Linux only")
def test_memory_is_that_of_this_process() -> None:
    import resource

    # It never held more than its peak (which the kernel counts in KB), and an interpreter with OpenCV and
    # NumPy holds more than 30 MB.
    assert 30 < memory_mb() <= resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 + 1


def test_memory_is_what_is_resident_not_what_is_reserved() -> None:
    page = mmap.PAGESIZE
    assert memory_of(f"{400 * 2**20 // page} {100 * 2**20 // page} 55 1 0 77 0") == 100
