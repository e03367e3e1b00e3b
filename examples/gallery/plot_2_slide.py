"""
Pressed, dragged, slipping
==========================

A ball is pressed into the gel and dragged until it slips. The area of the contact, the mean displacement of
the gel inside it, and the share of the contact that sticks, over time. `settings` adds the stage `slip`.
"""

import matplotlib.pyplot as plt
import numpy as np

import tactflow

results = list(tactflow.stream(source="sim:slide?frames=90", settings={"stages.slip": {}}))
touched = [result for result in results if result.contact is not None]


def drag(result):
    """Length of the mean displacement in the contact, px; NaN if no dot is inside."""
    mean = result.flow.mean if result.flow else None
    return np.nan if mean is None else np.hypot(*mean)


figure, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 6))
t = [result.t for result in touched]
axes[0].plot(t, [result.contact.area for result in touched])
axes[0].set_ylabel("area, px²")
axes[1].plot(t, [drag(result) for result in touched])
axes[1].set_ylabel("drag, px")
sticking = [np.nan if result.slip is None else result.slip.stick_ratio for result in touched]
axes[2].plot(t, np.array(sticking, float))
axes[2].set_ylabel("sticking")
axes[2].set_ylim(-0.05, 1.05)
axes[2].set_xlabel("time, s")
figure.tight_layout()
