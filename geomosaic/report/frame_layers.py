"""The map of a run of frames: footprints, moves, residuals, seams, ellipses, and what a reference says."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Bools, Floats
from geomosaic.composition.model import Mosaic
from geomosaic.export.ellipses import error_ellipses, exaggeration
from geomosaic.export.on_map import map_from_work
from geomosaic.export.orientation import Orientations
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.matching.model import TiePoints
from geomosaic.placement.model import Placement
from geomosaic.projection.footprint import footprint, ground_from_images
from geomosaic.quality.compare import Comparison
from geomosaic.quality.seam_check import SeamCheck
from geomosaic.quality.solved_tables import DOWN_WEIGHTED, tie_weights
from geomosaic.report.layers import MapLayer, arrows, flat, labels_of, outlines, thinned, thinning_note
from geomosaic.report.numbers import on_ground, short, whole
from geomosaic.survey.model import Survey

_MOST_ARROWS: Final = 2500
_MOST_TIES: Final = 8000
_MOST_CORNERS: Final = 40_000
"""Of all seams together."""
_FINE_OUTLINES: Final = 400
_ARROWS_OF_SPACING: Final = 0.05
"""How long the typical residual is drawn, of the way to the next frame."""
_LONGEST: Final = 6.0
"""How many times longer than the median one a residual is drawn at most."""
_JUMPS_PX: Final = 3.0
"""From here on a seam is called bad: `quality.verdict`'s limit."""


def map_footprints_m(survey: Survey, adjusted: Adjusted, placed: Bools) -> list[Floats]:
    """The outlines on the map, (k, 2) each, without points whose ray misses the ground; of frames without a
    place (`Orientations.placed`) none."""
    per_side = 4 if len(survey.frames) <= _FINE_OUTLINES else 1
    out = []
    for i, camera in enumerate(adjusted.cameras):
        outline = footprint(adjusted.poses[i], camera, adjusted.ground, per_side)
        seen = outline[np.isfinite(outline).all(axis=1)]
        out.append(map_from_work(survey, seen) if len(seen) and placed[i] else np.empty((0, 2)))
    return out


@dataclass(frozen=True)
class FrameLayers:
    """Makes the layers of a run; origin: what the map counts from; pixel_m: of the reduced mosaic. Frames
    are shown on demand, next to control and check points."""

    survey: Survey
    placement: Placement
    ties: TiePoints
    adjusted: Adjusted
    orientation: Orientations
    footprints_m: Sequence[Floats]
    origin: Floats
    pixel_m: float

    def all(self, mosaic: Mosaic, seams: SeamCheck | None, comparison: Comparison | None) -> list[MapLayer]:
        """From below to above, empty ones too."""
        return [
            self._footprints(),
            self._seams(mosaic),
            *self._ties(),
            self._lines(),
            self._residuals(),
            *self._displacements(comparison),
            self._ellipses(),
            self._moves(),
            self._holes(mosaic),
            self._jumps(seams),
            self._frames(),
        ]

    @property
    def _at_m(self) -> Floats:
        return self.orientation.map_m

    @property
    def _odd(self) -> list[int]:
        return [i for i, status in enumerate(self.adjusted.status) if status != "tied"]

    @property
    def _unscaled_px_m(self) -> float | None:
        """The ground pixel of a map without a scale."""
        return self.placement.ground_pixel_m if is_local(self.survey.map_crs) else None

    def _on_ground(self, length_m: float) -> str:
        return on_ground(length_m, self._unscaled_px_m)

    def _footprints(self) -> MapLayer:
        return MapLayer(
            "footprints", "Footprints", "#00b4d8", areas=outlines(self.footprints_m, self.origin),
            rows=list(range(len(self.survey.frames))), odd=self._odd, weight=1.2,
            shown=not self.adjusted.control,
        )  # fmt: skip

    def _frames(self) -> MapLayer:
        status = ["" if s == "tied" else s for s in self.adjusted.status]
        known = self.orientation.placed
        return MapLayer(
            "frames", "Frames", "#ffffff",
            points=[flat(p, self.origin) if k else [] for p, k in zip(self._at_m, known, strict=True)],
            rows=list(range(len(known))), odd=self._odd, shown=not self.adjusted.control,
            labels=labels_of([f.name for f in self.survey.frames], status), note="orange: not tied",
        )  # fmt: skip

    def _lines(self) -> MapLayer:
        lines = []
        for line in sorted(set(self.placement.lines)):
            part = self._at_m[[i for i in self.placement.sequence if self.placement.lines[i] == line]]
            part = part[np.isfinite(part).all(axis=1)]
            if len(part) > 1:
                lines.append(flat(part, self.origin))
        return MapLayer("flight", "Flight lines", "#ffffff", lines=lines, weight=1.0, dash="6 5")

    def _ties(self) -> list[MapLayer]:
        by_number = sorted(self.ties.pairs, key=len, reverse=True)[:_MOST_TIES]
        note = "; ".join(
            f"{short(float(np.quantile([len(p) for p in self.ties.pairs], q)))} tie points {words}"
            for q, words in ((0.5, "in the median pair"), (0.05, "or fewer in 5 %"))
            if self.ties.pairs
        )
        known = self.orientation.placed

        def between(pairs: Iterable[tuple[int, int]]) -> list[list[float]]:
            return [flat(self._at_m[list(p)], self.origin) for p in pairs if known[list(p)].all()]

        drawn, vain = between((p.left, p.right) for p in by_number), between(self.ties.untied[:_MOST_TIES])
        return [
            MapLayer("ties", "Tied pairs", "#7ae582", lines=drawn, weight=1.2, note=note),
            MapLayer("untied", "Pairs tried in vain", "#ff7043", lines=vain, weight=1.0, dash="3 5"),
        ]

    def _moves(self) -> MapLayer:
        before = map_from_work(self.survey, self.placement.poses.positions_m)
        vectors = self._at_m - before
        factor = exaggeration(np.linalg.norm(vectors, axis=1), before)
        note = f"from the given position to the adjusted one, {_larger(factor)}"
        lines = arrows(before, vectors, factor, self.origin)
        return MapLayer("moves", "POS to adjusted", "#e0218a", lines=lines, weight=2.2, note=note)

    def _residuals(self) -> MapLayer:
        """Where the left frame of a tie point puts it, to where the right one does."""
        nothing = np.zeros((0, 2))
        left = np.repeat([p.left for p in self.ties.pairs], [len(p) for p in self.ties.pairs]).astype(np.intp)
        px = np.concatenate([nothing, *(p.left_px for p in self.ties.pairs)])
        shift = np.concatenate([nothing, *self.adjusted.residuals_m])
        weights = tie_weights(self.ties, self.adjusted.image_residuals)
        trusted = ~(np.concatenate([np.zeros(0), *weights]) < DOWN_WEIGHTED)
        usable = np.flatnonzero(trusted) if len(shift) == len(left) else np.zeros(0, np.int64)
        taken = usable[thinned(len(usable), _MOST_ARROWS)]
        a = self.adjusted
        at = ground_from_images(left[taken], px[taken], a.poses, a.cameras, a.ground)
        at[~self.orientation.placed[left[taken]]] = np.nan
        start = map_from_work(self.survey, at)
        vectors = map_from_work(self.survey, at + np.pad(shift[taken], ((0, 0), (0, 1)))) - start
        length = np.linalg.norm(vectors, axis=1)
        longest = _LONGEST * float(np.nanmedian(length)) if np.isfinite(length).any() else 1.0
        vectors *= np.minimum(1.0, longest / np.maximum(length, 1e-9))[:, None]
        factor = exaggeration(length, self._at_m, _ARROWS_OF_SPACING)
        thin = thinning_note(len(taken), len(usable))
        cut = f", cut at {self._on_ground(longest)}" if np.nanmax(length, initial=0.0) > longest else ""
        note = f"of tie points that count, left to right frame, {_larger(factor)}{cut}{thin}"
        lines = arrows(start, vectors, factor, self.origin)
        return MapLayer("residuals", "Residuals", "#ff6b6b", lines=lines, weight=1.1, note=note)

    def _seams(self, mosaic: Mosaic) -> MapLayer:
        rings = [np.asarray(ring) for line in mosaic.seamlines for p in line.polygons for ring in p]
        finest = self.pixel_m
        while rings:
            simple = [np.asarray(shapely.LinearRing(r).simplify(finest).coords) for r in rings]
            if sum(map(len, simple)) <= _MOST_CORNERS:
                break
            finest *= 2.0
        drawn = [flat(r, self.origin, 1) for r in simple] if rings else []
        return MapLayer("seams", "Seams", "#ffe100", lines=drawn, weight=1.4)

    def _jumps(self, seams: SeamCheck | None) -> MapLayer:
        """Places on the seams where the ground was compared in the pixels."""
        if seams is None:
            return MapLayer("jumps", "", "")
        known = np.flatnonzero(np.isfinite(seams.length_px))
        names = [f.name for f in self.survey.frames]
        return MapLayer(
            "jumps", "Checked places on seams", "#38b000",
            points=[flat(seams.at_m[i], self.origin) for i in known],
            odd=[k for k, i in enumerate(known) if seams.length_px[i] > _JUMPS_PX],
            labels=[
                f"{names[seams.left[i]]} / {names[seams.right[i]]}: {short(float(seams.length_px[i]), 'px')}"
                for i in known
            ],
            note=f"orange: the ground jumps by more than {_JUMPS_PX:g} px",
        )  # fmt: skip

    def _ellipses(self) -> MapLayer:
        if self.adjusted.pose_covariance is None:
            return MapLayer("ellipses", "", "")
        ellipses = error_ellipses(self.orientation.covariance_m2[:, :2, :2])
        factor = exaggeration(ellipses.semi_major_m, self._at_m)
        rings = ellipses.outlines_m(self._at_m, factor)[:, ::2]
        usual = self._on_ground(float(np.nanmedian(ellipses.semi_major_m)))
        note = f"of 1 σ, {_larger(factor)}; median semi-axis {usual}"
        return MapLayer(
            "ellipses", "Error ellipses", "#b388ff", areas=outlines(rings, self.origin),
            rows=list(range(len(rings))), weight=1.4, fill=0.18, odd=self._odd, note=note,
        )  # fmt: skip

    def _displacements(self, comparison: Comparison | None) -> list[MapLayer]:
        """The mosaic against the reference, as measured, and as the best similarity leaves it."""
        if comparison is None or not len(comparison.vectors_m):
            return []
        out, (at, vectors) = [], np.hsplit(comparison.vectors_m, 2)
        taken = thinned(len(at), _MOST_ARROWS)
        for name, title, left in (
            ("displaced", "Displacement", vectors),
            ("left", "Displacement after similarity", after_similarity(comparison)),
        ):
            if not np.isfinite(left).any():
                continue
            factor = exaggeration(np.linalg.norm(left, axis=1), self._at_m, 2.0 * _ARROWS_OF_SPACING)
            note = f"mosaic minus reference, {_larger(factor)}{thinning_note(len(taken), len(at))}"
            lines = arrows(at[taken], left[taken], factor, self.origin)
            out.append(MapLayer(name, title, "#ff6b6b", lines=lines, weight=1.3, note=note))
        return out

    def _holes(self, mosaic: Mosaic) -> MapLayer:
        holes = mosaic.holes.largest
        px_m = self._unscaled_px_m
        areas = [short(h.area_m2 if px_m is None else h.area_m2 / px_m**2) for h in holes]
        unit = "m²" if px_m is None else "px²"
        return MapLayer(
            "holes", "Holes", "#ff1744",
            points=[flat(np.array([h.easting_m, h.northing_m]), self.origin) for h in holes],
            labels=[f"no frame shows {area} {unit} here" for area in areas], shown=True,
        )  # fmt: skip


def after_similarity(comparison: Comparison) -> Floats:
    """What the best shift, turn and scale leave of the displacements, (n, 2); NaN where there is none."""
    at, vectors = np.hsplit(comparison.vectors_m, 2)
    s = comparison.figures.similarity
    about = (at - [s.centre_east_m, s.centre_north_m]) @ [1.0, 1.0j]
    turned = (s.scale * np.exp(1j * s.rotation_rad) - 1.0) * about
    return np.asarray(
        vectors - np.stack([turned.real, turned.imag], axis=-1) - [s.shift_east_m, s.shift_north_m]
    )


def _larger(factor: float) -> str:
    return "true to scale" if factor == 1.0 else f"drawn {whole(factor)} times larger"
