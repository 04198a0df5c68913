"""The plan in Rerun: metres in the work frame, north up, nothing from any network."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.recording.file.model import Recording
from geomosaic.recording.inspect.plan import LEGEND, PlanLayer, plan_layers

PLAN: Final = "/plan"
NAME: Final = f"plan, m: {LEGEND}"


def draw_plan(recording: Recording, stream: Any) -> None:
    """Draws what is known so far, over what was drawn before."""
    for layer in plan_layers(recording):
        stream.log(f"{PLAN}/{layer.name}", _drawn(layer), static=True)


def ui(points: float | Floats) -> Any:
    """A radius in points of the screen."""
    import rerun

    return rerun.Radius.ui_points(points)


def _drawn(layer: PlanLayer) -> Any:
    """As Rerun draws: down is positive."""
    import rerun

    parts = [np.asarray(part[:, :2] * [1.0, -1.0]) for part in layer.parts_m]
    radii, order = ui(layer.wide), layer.order
    colours = np.atleast_2d(np.asarray(layer.colours, np.uint8))
    if layer.kind == "points":
        at, labels = np.array(parts).reshape(-1, 2), list(layer.labels) or None
        colours = colours // 2 + 128 if layer.named else colours
        return rerun.Points2D(
            at, colors=colours, radii=radii, labels=labels, show_labels=layer.named, draw_order=order
        )
    if layer.kind == "arrows":
        ends = np.array(parts).reshape(-1, 2, 2)
        return rerun.Arrows2D(
            origins=ends[:, 0], vectors=ends[:, 1] - ends[:, 0], colors=colours, radii=radii, draw_order=order
        )
    if layer.kind == "rings":
        parts = [np.concatenate([ring, ring[:1]]) for ring in parts]
    return rerun.LineStrips2D(parts, colors=colours, radii=radii, draw_order=order)
