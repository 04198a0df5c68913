"""OpenCV's own stitcher for scans, as its sample calls it: `opencv_scans.py FRAMES OUT`.

Writes OUT/mosaic.tif, which lies nowhere and whose fourth band is 255 where it shows something, and
OUT/report.json with the number of frames it used.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np


def main() -> int:
    """Exit code 1 where nothing came out."""
    frames, out = map(Path, sys.argv[1:])
    images = [cv2.imread(str(path), cv2.IMREAD_COLOR) for path in sorted(frames.iterdir())]
    stitcher = cv2.Stitcher_create(cv2.Stitcher_SCANS)
    status, mosaic = stitcher.stitch([image for image in images if image is not None])
    if status != cv2.Stitcher_OK:
        print(f"the stitcher gave up with status {status}")
        return 1
    cv2.imwrite(str(out / "mosaic.tif"), np.dstack([mosaic, shown(mosaic)]))
    (out / "report.json").write_text(json.dumps({"images_used": len(stitcher.component())}))
    return 0


def shown(mosaic: np.ndarray) -> np.ndarray:
    """255 where a mosaic (rows, cols, 3) shows something: the stitcher tells nobody, so that black which goes
    on to its rim counts as nothing."""
    black = np.pad((~mosaic.any(axis=2)).view(np.uint8), 1, constant_values=1)
    cv2.floodFill(black, None, (0, 0), 2)
    return np.where(black[1:-1, 1:-1] == 2, 0, 255).astype(np.uint8)


if __name__ == "__main__":
    raise SystemExit(main())
