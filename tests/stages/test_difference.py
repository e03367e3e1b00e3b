"""Stage `difference`: which frames are the reference, and what comes out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import tactflow
from tactflow.engine.frame import Frame
from tactflow.sim import open_scene
from tactflow.stages.difference import Difference

Image = NDArray[np.uint8]


def _stage(**params: Any) -> Difference:
    return Difference(Difference.Params(**params))


def _frame(image: Image, seq: int, *, reference: bool = False) -> Frame:
    return Frame("main", seq, seq / 60, image, reference=reference)


def _touched() -> tuple[Image, Image]:
    scene = open_scene("unmarked?frames=60")
    return scene.frame(0), scene.frame(25)


@pytest.mark.parametrize("marked", [True, False])
def test_a_touched_gel_is_told_from_the_reference_or_else_from_the_first_frame(marked: bool) -> None:
    untouched, touched = _touched()
    stage = _stage()
    mask, touching, *_ = stage.process(untouched, _frame(untouched, 0, reference=marked))
    assert not touching
    assert not mask.any()
    mask, touching, *_ = stage.process(touched, _frame(touched, 1))
    assert touching
    assert mask.shape == touched.shape[:2]
    assert set(np.unique(mask)) == {0, 255}
    stage.reset()
    assert not stage.process(touched, _frame(touched, 2, reference=True)).touching


def test_all_marked_frames_are_learned_from() -> None:
    rng = np.random.default_rng(9)
    images = [rng.normal(120, 4, (64, 64, 3)).round().astype(np.uint8) for _ in range(9)]
    one, many = _stage(repeatability=0, shift=0), _stage(repeatability=0, shift=0)
    for seq, image in enumerate(images[:8]):
        many.process(image, _frame(image, seq, reference=True))
    one.process(images[0], _frame(images[0], 0, reference=True))
    change = images[8].copy()
    change[20:44, 20:44] += 2
    # The mean of eight frames is less noisy than one frame, and their spread is known rather than guessed.
    assert many.process(change, _frame(change, 9)).touching
    assert not one.process(change, _frame(change, 9)).touching


def test_a_reference_that_was_touched_is_replaced_after_the_release() -> None:
    untouched, touched = _touched()
    stage, asked = _stage(patience=3), []
    stage.process(touched, _frame(touched, 0, reference=True))
    for seq in range(1, 5):
        ports = stage.process(untouched, _frame(untouched, seq))
        assert not ports.touching
        assert not ports.contact_mask.any()
        asked.append(stage.wants_reference)
        stage.wants_reference = None
    assert asked == [None, None, "reference_touched", None]


def test_a_whole_run_recovers_from_a_touched_first_frame() -> None:
    scene = open_scene("unmarked?frames=60")
    pressed, free = scene.frame(25), scene.frame(1)
    pictures = [*[pressed] * 5, *[free] * 12, *[pressed] * 5]
    settings = {"stages.capture.settle": 0, "stages.difference.patience": 5, "skipping": False}
    results = list(tactflow.stream("markerless", source=pictures, settings=settings))
    assert [result.contact is not None for result in results] == [False] * 17 + [True] * 5
    assert [result.skipped["reference"] for result in results if "reference" in result.skipped] == [
        "reference_touched"
    ]
