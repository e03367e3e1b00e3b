"""The frames of light-and-dots.md that are called contact at rest, and how far the dots have moved in them.

    python docs/at_rest.py [FOLDER]

FOLDER holds the recordings `gels`; without it, `../shared/data` beside the repository. Takes ten seconds.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import tactflow
from tactflow.bench.gels import FOLDER, GELS

BESIDE = 3
"""So many frames before and after are shown as well."""
RESTING = 0.5
"""Rest is below this 95th percentile of the dots' displacement, px, where nothing else is known."""


def main() -> None:
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "shared" / "data"
    for gel in (gel for gel in GELS if gel.folder in ("sts_torque160", "sts_640", "tactip_video")):
        moved, evidence = [], []
        settings = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": gel.downsample}
        for result in tactflow.stream(source=gel.sources(data / FOLDER)[0], settings=settings):
            assert result.markers is not None
            seen = result.markers.displacement[result.markers.status == 0]
            moved.append(float(np.percentile(np.hypot(*seen.T), 95)))
            evidence.append(result.contact.evidence if result.contact else None)
        rest = np.arange(len(moved)) < gel.rest if gel.rest else np.array(moved) < RESTING
        wrong = [index for index in np.flatnonzero(rest) if evidence[index]]
        print(f"{gel.folder}: {len(wrong)} of {np.count_nonzero(rest)} frames at rest")
        for index in wrong:
            around = ", ".join(f"{far:.2f}" for far in moved[max(0, index - BESIDE) : index + BESIDE + 1])
            print(f"  frame {index}: {evidence[index]}; dots {moved[index]:.2f} px; around it {around}")


if __name__ == "__main__":
    main()
