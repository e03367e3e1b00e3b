"""Functions for a notebook: one contact from two pictures, a picture of a result, results as a table or as
curves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactflow.drawing.curves import collected
from tactflow.drawing.plots import styled_figure
from tactflow.drawing.results import Annotator
from tactflow.message.columns import frame_columns
from tactflow.message.result import Result
from tactflow.streaming import stream
from tactflow.vision.types import Contact

if TYPE_CHECKING:
    import pandas as pd  # type: ignore[import-untyped]
    from matplotlib.figure import Figure

PLOT_COLUMNS = 3
"""Plots beside each other."""
PLOT_WIDTH, PLOT_HEIGHT = 360, 220
"""Size of a plot, px."""

_UNCHANGED_PICTURES = {
    "stages.preprocess.rotate": 0,
    "stages.preprocess.downsample": 1,
    "stages.capture.settle": 0,
}
"""Settings of the default pipeline that use pictures unchanged and in this order."""
_NO_COLUMN = frozenset({"changed", "evidence", "touching"})
"""Ports of built-in stages that duplicate other columns."""


def contact(image: NDArray[np.uint8], reference: NDArray[np.uint8]) -> Contact | None:
    """Find the contact in one picture, with the default pipeline.

    For many pictures of one sensor, `tactflow.stream(source=pictures)` prepares the reference only once.

    Parameters
    ----------
    image : (H, W, 3) uint8 BGR or (H, W) uint8 grey.
    reference : of the same shape: the gel at rest, under the same light.

    Returns
    -------
    The contact, in pixels of `image`; None without contact.

    Raises
    ------
    ValueError : the pictures differ in shape. TactflowError : the pipeline cannot process the pictures.

    Examples
    --------
    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> found = tactflow.contact(scene.frame(60), reference=scene.frame(0))
    >>> found is not None, tactflow.contact(scene.frame(1), reference=scene.frame(0))
    (True, None)
    """
    if image.shape != reference.shape:
        raise ValueError(f"required pictures of one shape, got {image.shape} and {reference.shape}")
    *_, result = stream("default", source=[reference, image], settings=_UNCHANGED_PICTURES)
    return result.contact


def draw(result: Result, image: NDArray[np.uint8] | None = None, **options: Any) -> NDArray[np.uint8]:
    """Draw a result on the processed frame: outline and axis of the contact, arrows of the markers.

    Parameters
    ----------
    result : from `tactflow.stream(..., images=True)`.
    image : (H, W, 3) uint8 BGR to draw on; None: that of the result.
    options : of the stage `visualize`: `arrow_scale`, `view` ("frame", "contact", "depth" or
        "normals"), `text`, `deepest`.

    Returns
    -------
    (H, W, 3) uint8 BGR, a new picture.

    Raises
    ------
    ValueError : the result has no picture, or an option is out of range.

    Examples
    --------
    >>> import tactflow
    >>> result = next(tactflow.stream(source="sim:press", images=True, max_frames=1))
    >>> tactflow.draw(result, text=False).shape
    (400, 300, 3)
    """
    image = result.image if image is None else image
    if image is None:
        raise ValueError("the result has no picture: use tactflow.stream(..., images=True), or give an image")
    return Annotator(**options)(
        image,
        contact=result.contact,
        flow=result.flow,
        markers=result.markers,
        contact_mask=result.contact_mask,
        valid=result.value("valid"),
        field=result.field,
        depth=result.depth,
        scale=result.scale,
        normals=result.normals,
    )


def plot(results: Iterable[Result]) -> Figure:
    """Plot results over time: area, centre, flow, depth, force, slip, whichever they have; contacts shaded.

    Parameters
    ----------
    results : from `stream`, or received; read to the end.

    Returns
    -------
    A figure of matplotlib, which a notebook shows; `figure.savefig("run.png")` writes it.

    Raises
    ------
    ImportError : matplotlib is not installed. ValueError : there are no results.

    Examples
    --------
    >>> import tactflow
    >>> figure = tactflow.plot(tactflow.stream(source="sim:press", max_frames=60))
    >>> [axes.get_title(loc="left") for axes in figure.axes][:2]
    ['Area of the contact, px²', 'Centre of the contact, px']
    """
    curves = collected(result.to_dict() for result in results)
    if not len(curves.t):
        raise ValueError("there are no results to plot")
    present = curves.present()
    columns = max(1, min(PLOT_COLUMNS, len(present)))
    rows = max(1, -(-len(present) // columns))
    try:
        with styled_figure(PLOT_WIDTH * columns, PLOT_HEIGHT * rows) as figure:
            for place, quantity in enumerate(present):
                curves.draw(figure.add_subplot(rows, columns, place + 1), quantity)
    except ModuleNotFoundError:
        raise ImportError("tactflow.plot needs matplotlib: pip install 'tactflow[plot]'") from None
    return figure


def to_frame(results: Iterable[Result]) -> pd.DataFrame:
    """Results as a pandas DataFrame, one row per frame.

    Columns are the numbers of the result message with its standard errors (`contact_area`, `flow_mean_x`,
    `flow_stderr_x`, ...), then the numbers, booleans and strings from your own stages. Empty columns are
    omitted.

    results : from `stream`, or received.

    Raises
    ------
    ImportError : pandas is not installed.

    Examples
    --------
    >>> import tactflow
    >>> table = tactflow.to_frame(tactflow.stream(source="sim:press", max_frames=60))
    >>> len(table), bool(table["contact_area"].max() > 0)
    (60, True)
    """
    try:
        import pandas as pd
    except ImportError:
        raise ImportError("tactflow.to_frame needs pandas: pip install 'tactflow[pandas]'") from None
    columns = [column for column in frame_columns() if column.kind not in ("numbers", "points", "words")]
    rows = []
    for result in results:
        message = result.to_dict(detail=True)
        row = {column.name: column.value(message) for column in columns}
        rows.append(row | {port: value for port, value in result.items() if _is_cell(port, value)})
    return pd.DataFrame(rows).dropna(axis="columns", how="all")


def _is_cell(port: str, value: object) -> bool:
    is_scalar = isinstance(value, bool | int | float | str | np.generic)
    return is_scalar and port not in _NO_COLUMN and "." not in port
