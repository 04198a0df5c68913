"""Points and their marks while they are marked: each change is saved before it is answered."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import utm_crs
from geomosaic.marking.frame_tiles import TILE_PX, FrameTiles
from geomosaic.marking.marked_points import save_points
from geomosaic.marking.oriented_frames import OrientedFrames
from geomosaic.marking.predicted_places import predicted_places
from geomosaic.marking.target_refinement import refined
from geomosaic.survey.model import ControlPoint

_DECIMALS: Final = 3
"""Of col and row, as they are saved."""
_NO_CORNER: Final = "no corner of a target within a few pixels; the mark stays where it is"


class MarkingSession:
    """Points, their marks and the folder that these are saved to. May be changed from several threads."""

    def __init__(self, frames: OrientedFrames, points: tuple[ControlPoint, ...], folder: Path) -> None:
        self.frames, self.folder = frames, folder
        self.tiles = FrameTiles(frames.frames)
        self._points = points
        self._lock = threading.Lock()

    @property
    def points(self) -> tuple[ControlPoint, ...]:
        """The points as they are now."""
        return self._points

    def survey(self) -> dict[str, Any]:
        """What does not change: frames with their outlines, points with their places, in metres east and
        north."""
        frames = [
            {
                "name": frame.name,
                "width": frame.width_px,
                "height": frame.height_px,
                "at": np.round(self.frames.poses[i].position_m[:2], 2).tolist(),
                "outline": np.round(self.frames.outline_m(i), 2).tolist(),
            }
            for i, frame in enumerate(self.frames.frames)
        ]
        places = np.round(self.frames.places_m(self._points)[:, :2], 3).tolist()
        if not self.frames.on_earth:
            places = [None] * len(places)
        points = [{"name": p.name, "at": at} for p, at in zip(self._points, places, strict=True)]
        return {
            "frames": frames,
            "points": points,
            "source": self.frames.source,
            "folder": str(self.folder),
            "tile": TILE_PX,
        }

    def state(self) -> dict[str, Any]:
        """The kind of each point and the frames that show it, first those where it is nearest to the middle.
        Each frame has the predicted place, the mark, and how far the mark is from where the others predict
        it. Where nothing can be predicted, all frames are listed."""
        points, frames = self._points, self.frames.frames
        places = predicted_places(self.frames, points)
        sizes = np.array([(f.width_px, f.height_px) for f in frames], dtype=np.float64)
        number = {frame.name: i for i, frame in enumerate(frames)}
        listed = []
        for k, point in enumerate(points):
            marks = {number[name]: [col, row] for name, col, row in point.images}
            every = [*range(len(frames))]
            known = self.frames.on_earth or bool(np.isfinite(places.image_px[:, k]).any())
            expected = places.expected(k, sizes) if known else every
            shown = [
                {
                    "frame": i,
                    "predicted": _rounded(places.image_px[i, k]),
                    "mark": marks.get(i),
                    "off": places.off_px.get((k, i)),
                    "suspect": (k, i) in places.suspect,
                }
                for i in [*expected, *(i for i in marks if i not in expected)]
            ]
            listed.append({"check": point.check, "frames": shown})
        return {"points": listed}

    def mark(self, point: int, frame: int, at: tuple[float, float] | None, refine: bool = False) -> str:
        """Sets or removes the mark of a point in a frame, and saves. Returns what the user should know.

        Args: point, frame: their numbers; at: col and row, None to remove; refine: to the target's centre.
        Raises: `InputError` for a place outside the frame, or a frame that cannot be read; `OutputError`.
        """
        name, said = self._frame(frame).name, ""
        if at is not None:
            self._check_inside(frame, at)
            if refine:
                found = self._refined(frame, at)
                at, said = (found, "") if found is not None else (at, _NO_CORNER)
            at = round(at[0], _DECIMALS), round(at[1], _DECIMALS)
        with self._lock:
            old = self._point(point)
            others = tuple(image for image in old.images if image[0] != name)
            images = others if at is None else (*others, (name, *at))
            self._change(point, replace(old, images=images))
        return said

    def set_kind(self, point: int, check: bool) -> None:
        """Makes a point a check or a control point, and saves. Raises: `InputError`, `OutputError`."""
        with self._lock:
            self._change(point, replace(self._point(point), check=check))

    def _change(self, k: int, point: ControlPoint) -> None:
        points = (*self._points[:k], point, *self._points[k + 1 :])
        save_points(self.folder, points, self._list_crs())
        self._points = points

    def _list_crs(self) -> str:
        """The map's CRS; the UTM zone of the points where frames have no place on the Earth."""
        if self.frames.on_earth:
            return self.frames.survey.map_crs
        lon, lat = np.median([(p.lon_deg, p.lat_deg) for p in self._points], axis=0).tolist()
        return utm_crs(lon, lat)

    def _point(self, k: int) -> ControlPoint:
        if not 0 <= k < len(self._points):
            raise InputError(f"there is no point {k}", fix="load the page again")
        return self._points[k]

    def _frame(self, i: int) -> Any:
        if not 0 <= i < len(self.frames.frames):
            raise InputError(f"there is no frame {i}", fix="load the page again")
        return self.frames.frames[i]

    def _check_inside(self, i: int, at: tuple[float, float]) -> None:
        frame = self._frame(i)
        if not (0.0 <= at[0] <= frame.width_px and 0.0 <= at[1] <= frame.height_px):
            raise InputError("the mark lies outside the frame", fix="mark a place inside it")

    def _refined(self, i: int, at: tuple[float, float]) -> tuple[float, float] | None:
        pixels = self.tiles.pixels(i, 1)
        grey = pixels[..., 0] if pixels.shape[2] == 1 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        return refined(grey, *at)


def _rounded(px: np.ndarray[Any, np.dtype[np.float64]]) -> list[float] | None:
    return np.round(px, 2).tolist() if np.isfinite(px).all() else None
