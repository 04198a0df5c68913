"""A page of crops of finished runs for people to look at: seams, and what there is besides them.

    python -m tools.bench.contact_sheet OUT [--before OUT] [--page OUT/crops.html]

OUT holds run folders, as `bench_flights --out` leaves them. Twenty crops of each mosaic at 100 %: half of
them where frames meet, half of any ground, each as unlike those before as there are. With --before, the same
places of the run of that name there are shown with them.
"""

from __future__ import annotations

import argparse
import base64
import html
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.windows import Window

SIDE_PX, COUNT, REDUCTION = 400, 20, 8
_STYLE = """body{background:#222;color:#eee;font:14px sans-serif}figure{display:inline-block;margin:4px}
img{display:inline-block}figcaption{color:#aaa}"""


def places(run: Path, count: int = COUNT) -> list[tuple[int, int, int, bool]]:
    """Crops' first pixels (col, row), their sides in px, and whether they were chosen for a seam."""
    with rasterio.open(run / "mosaic.tif") as mosaic, rasterio.open(run / "sources.tif") as sources:
        side = min(SIDE_PX, min(mosaic.shape) // 4 // REDUCTION * REDUCTION)
        if not side:
            return []
        rows, cols = (n // side for n in mosaic.shape)
        whole = Window(0, 0, cols * side, rows * side)
        shape = rows * side // REDUCTION, cols * side // REDUCTION
        bands = mosaic.indexes[: 3 if mosaic.count >= 3 else 1]
        small = mosaic.read(
            bands, window=whole, out_shape=(len(bands), *shape), resampling=Resampling.average
        )
        valid = mosaic.dataset_mask(window=whole, out_shape=shape) > 0
        label = sources.read(1, window=whole, out_shape=shape, resampling=Resampling.nearest)
    blocks = _blocks(
        np.vstack([small, valid[None], _meeting(label)[None]]).astype(np.float64), side // REDUCTION
    )
    full = np.flatnonzero(blocks[:, -2].min(axis=1) > 0)
    if not len(full):
        return []
    look = np.hstack([blocks[full, :-2].mean(axis=2), blocks[full, :-2].std(axis=2)])
    seam = blocks[full, -1].mean(axis=1)
    often = np.flatnonzero(seam > np.median(seam))
    first = often[_unlike(look[often], count // 2)]
    rest = np.setdiff1d(np.arange(len(full)), first)
    both = [(k, True) for k in first] + [(rest[k], False) for k in _unlike(look[rest], count - len(first))]
    return [(int(full[k] % cols) * side, int(full[k] // cols) * side, side, meets) for k, meets in both]


def _meeting(label: NDArray[Any]) -> NDArray[np.bool_]:
    """Where another source begins."""
    out = np.zeros(label.shape, dtype=bool)
    out[:, 1:] |= label[:, 1:] != label[:, :-1]
    out[1:] |= label[1:] != label[:-1]
    return out


def _blocks(values: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """(blocks, bands, pixels) of values (bands, h, w), row by row."""
    bands, height, width = values.shape
    cut = values.reshape(bands, height // side, side, width // side, side).transpose(1, 3, 0, 2, 4)
    return np.asarray(cut.reshape(-1, bands, side * side))


def _unlike(look: NDArray[np.float64], count: int) -> list[int]:
    """Some of these (n, k), each the one farthest from all before."""
    chosen: list[int] = []
    away = np.linalg.norm(look - np.median(look, axis=0), axis=1) if len(look) else np.zeros(0)
    while len(chosen) < min(count, len(look)):
        chosen.append(int(away.argmax()))
        near = np.linalg.norm(look - look[chosen[-1]], axis=1)
        away = near if len(chosen) == 1 else np.minimum(away, near)
    return chosen


def _image(run: Path, bounds: Sequence[float]) -> str:
    """A data URI of a place on the map."""
    with rasterio.open(run / "mosaic.tif") as mosaic:
        west, south, east, north = bounds
        (left, top), (right, below) = (~mosaic.transform @ at for at in ((west, north), (east, south)))
        cols, rows = (max(round(left), 0), round(right)), (max(round(top), 0), round(below))
        window = Window.from_slices(slice(*rows), slice(*cols))
        bands = mosaic.indexes[: 3 if mosaic.count >= 3 else 1]
        pixels = np.moveaxis(mosaic.read(bands, window=window), 0, -1)
    if pixels.dtype != np.uint8:
        low, high = np.quantile(pixels, [0.01, 0.99])
        pixels = np.clip((pixels - low) / max(high - low, 1e-9) * 255.0, 0.0, 255.0).astype(np.uint8)
    ok, jpeg = cv2.imencode(".jpg", pixels[..., ::-1] if pixels.shape[2] == 3 else pixels)
    assert ok
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode("ascii")


def _figures(run: Path, before: Path | None) -> Iterator[str]:
    with rasterio.open(run / "mosaic.tif") as mosaic:
        transform = mosaic.transform
    for col, row, side, at_seam in places(run):
        west, north = transform @ (col, row)
        east, south = transform @ (col + side, row + side)
        runs = [run, *([before] if before is not None and (before / "mosaic.tif").is_file() else [])]
        images = "".join(f'<img src="{_image(r, (west, south, east, north))}">' for r in runs)
        what = "seam" if at_seam else "ground"
        yield f"<figure>{images}<figcaption>{what}, {west:.0f} E {north:.0f} N</figcaption></figure>"


def write_page(page: Path, runs: Sequence[Path], before: Path | None = None) -> None:
    """Writes the page of these runs."""
    parts = [f'<!doctype html><meta charset="utf-8"><title>crops</title><style>{_STYLE}</style>']
    for run in runs:
        summary = json.loads((run / "run.json").read_text(encoding="utf-8"))
        verdict = html.escape(str((summary.get("verdict") or {}).get("grade", "")))
        parts.append(f"<h2>{html.escape(run.name)} {verdict}</h2>")
        parts += _figures(run, None if before is None else before / run.name)
    page.write_text("\n".join(parts), encoding="utf-8")


def main(argv: list[str] | None = None) -> int:
    """Writes the page of all finished runs of a folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder of run folders")
    parser.add_argument("--before", type=Path, help="folder of runs of the same names, to compare with")
    parser.add_argument("--page", type=Path, help="the page to write [OUT/crops.html]")
    asked = parser.parse_args(argv)
    runs = [p for p in sorted(asked.out.iterdir()) if (p / "run.json").is_file()]
    page = asked.page or asked.out / "crops.html"
    write_page(page, runs, asked.before)
    print(f"{page}: {len(runs)} runs")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
