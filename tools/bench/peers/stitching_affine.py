"""The package `stitching` with its affine model: `stitching_affine.py FRAMES OUT`.

Writes OUT/mosaic.tif, which lies nowhere and whose fourth band is 255 where it shows something, and
OUT/report.json with the number of frames it used. Runs in an environment of its own, without the project.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
from opencv_scans import shown
from stitching import AffineStitcher  # type: ignore[import-not-found]


def main() -> int:
    frames, out = map(Path, sys.argv[1:])
    stitcher = AffineStitcher(detector="sift", crop=False)
    mosaic = stitcher.stitch(sorted(str(path) for path in frames.iterdir() if path.suffix.lower() == ".jpg"))
    pixels = np.ascontiguousarray(np.clip(mosaic, 0, 255).astype(np.uint8))
    cv2.imwrite(str(out / "mosaic.tif"), np.dstack([pixels, shown(pixels)]))
    (out / "report.json").write_text(json.dumps({"images_used": len(stitcher.images.names)}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
