"""Control and check points as layers of the report's map, and the scale of their arrows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.report.control import MappedPoints
from geomosaic.report.layers import MapLayer, arrows, flat
from geomosaic.report.numbers import cm, whole

MARKS: Final = {"control": ("triangle", "#d7191c"), "check": ("square", "#1f66d0")}
"""Symbol and colour by kind, those of the QGIS project."""
_SHARE: Final = 0.1
"""How long the 90 % residual is drawn at most, of the map's longer side."""
_LONGEST: Final = 1.5
"""How many times longer than that an arrow is drawn at most."""
_HEAD: Final = 0.022
"""How long an arrow's head is at most, of the map's longer side."""


@dataclass(frozen=True)
class ArrowScale:
    """factor: how many times larger residuals are drawn; longest_m: residuals beyond are cut; head_m: length
    of an arrow's head on the map, at most."""

    factor: float
    longest_m: float
    head_m: float

    def drawn(self, residual_m: Floats) -> Floats:
        """Residuals (n, 2) as they are drawn, not yet enlarged: cut at the longest."""
        length = np.linalg.norm(residual_m, axis=1)
        return np.asarray(residual_m * np.minimum(1.0, self.longest_m / np.maximum(length, 1e-12))[:, None])

    def note(self, kinds: Sequence[MappedPoints]) -> str:
        """What the arrows are."""
        larger = "true to scale" if self.factor == 1.0 else f"drawn {whole(self.factor)} times larger"
        cut = any((np.linalg.norm(k.residual_m, axis=1) > self.longest_m).any() for k in kinds)
        words = f"arrow from where the map shows the point to where it was surveyed, {larger}"
        words += f", cut at {cm(self.longest_m)}" if cut else ""
        return words + (", crossed out: blunder" if any(k.blunders.any() for k in kinds) else "")


def arrow_scale(kinds: Sequence[MappedPoints], side_m: float) -> ArrowScale:
    """One scale for both kinds on a map of this longer side, by the points that are no blunders. It is 1, 2
    or 5 times a power of ten, at least 1."""
    lengths = [np.linalg.norm(k.residual_m, axis=1)[~k.blunders] for k in kinds]
    length = np.concatenate([*lengths, np.zeros(0)])
    usual_m = float(np.quantile(length, 0.9)) if length.size else 0.0
    most = _SHARE * side_m / max(usual_m, 1e-6)
    power = 10.0 ** np.floor(np.log10(max(most, 1.0)))
    factor = float(max(m for m in (1.0, 2.0, 5.0) if m * power <= max(most, 1.0)) * power)
    return ArrowScale(factor, _LONGEST * _SHARE * side_m / factor, _HEAD * side_m)


def control_layers(kinds: Sequence[MappedPoints], scale: ArrowScale, origin: Floats) -> list[MapLayer]:
    """Of each kind a layer, control points below; of many points the farthest off."""
    layers = []
    for kind in reversed(kinds):
        mark, colour = MARKS[kind.layer]
        shown = len(kind.names)
        few = f", the {shown} farthest of {whole(kind.number)}" if kind.number > shown else ""
        layers.append(
            MapLayer(
                kind.layer, kind.title, colour, shown=True, weight=2.4, mark=mark, factor=scale.factor,
                lines=arrows(kind.at_m, scale.drawn(kind.residual_m), scale.factor, origin, scale.head_m),
                points=[flat(at, origin) for at in kind.at_m], labels=list(kind.labels),
                odd=np.flatnonzero(kind.blunders).tolist(), note=scale.note(kinds) + few,
            )
        )  # fmt: skip
    return layers
