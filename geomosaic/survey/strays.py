"""Images in a folder of frames that don't belong to the survey: each kind is left out and named.

Judged against the other frames, never by a value alone, and in doubt a frame stays: what is merely odd the
adjustment judges.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geomosaic.arrays import Bools, Floats
from geomosaic.constants import CHOSEN, FEW, NORMAL_PER_MAD, tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.survey.cameras import unreported
from geomosaic.survey.damage import FrameAppearance
from geomosaic.survey.extent import TOO_FAR_M, away_m
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.lens_tags import label
from geomosaic.survey.model import Position, UnusedImage, Warn
from geomosaic.survey.names import natural_key, some
from geomosaic.survey.platforms import LEAST_FRAMES
from geomosaic.survey.plausible import NEIGHBOURS, Limit

LEAVE_OUT: Final = ("auto", "none")
_KEEP: Final = "--keep-strays uses them"
BANDS: Final = "ms"
"""The kind of a multispectral camera, whose files are one a band."""
COPY: Final = Limit(0.995, "correlation", "of small versions of copies; neighbours have less", CHOSEN)
_COPY_GREYS = tuned(4.0, "grey levels", "of mean and contrast: more takes bands for copies")
LOW: Final = Limit(0.3, "usual heights", "above ground: sees a tenth of what others see, in a climb", CHOSEN)
APART: Final = Limit(2.0, "extents", "of both flights, between them: their mosaic is mostly empty", CHOSEN)
_NEAR_M = tuned(500.0, "m", "between flights: less splits small surveys; fields of a flight are as far")
BLURRED: Final = Limit(
    2.3, "log detail", "a tenth of its neighbours', blurred over 4 px", "2 px blur: 2.4 to 3"
)
SPREADS: Final = Limit(6.0, "robust deviations", "of the frames' own fine detail, on top", CHOSEN)
_WORDS: Final = {
    "frame-other-bands": "other bands or pixel type than the frames of the mosaic",
    "frame-other-camera": "taken by another of the aircraft's cameras (--camera-kind chooses one)",
    "frame-no-temperature": "without temperatures that can be read",
    "frame-copy": "copies of other frames",
    "frame-take-off": "taken far below all others at the flight's beginning or end",
    "frame-far-away": "farther away than a survey reaches",
    "frame-other-place": "of another flight, far from the largest: mosaic it by itself",
    "frame-blurred": "far more blurred than their neighbours, which are sharp",
    "frame-no-camera": "of another camera or of none, and without a reported focal length",
}
_APART: Final = frozenset({"frame-other-bands", "frame-other-camera", "frame-no-temperature"})
"""Of images whose pixels or spectrum are not the mosaic's, so that --keep-strays would mix them or fail."""

Stray = tuple[str, UnusedImage]
"""The code of its warning, and the frame."""


def without(headers: Sequence[FrameHeader], strays: Sequence[Stray]) -> list[FrameHeader]:
    """The frames that are left."""
    names = {out.name for _, out in strays}
    return [h for h in headers if h.name not in names]


def without_camera(headers: Sequence[FrameHeader]) -> list[Stray]:
    """Frames of a camera and size that report no lens, as long as they are fewer than half. Else those of a
    size of their own that name no camera, where most name one: a program made them of other frames."""
    lacking, text = unreported(headers), "the frame doesn't report its focal length"
    if 2 * len(lacking) >= len(headers):
        named = [bool(h.exif.make or h.exif.model) for h in headers]
        sizes = {_size(h) for h, its in zip(headers, named, strict=True) if its}
        lacking = [i for i, h in enumerate(headers) if not named[i] and _size(h) not in sizes]
        text = "the frame names no camera, as the others do, and has another size"
    if 2 * len(lacking) >= len(headers):
        return []
    return [_out("frame-no-camera", headers[i], text) for i in lacking]


def _size(header: FrameHeader) -> tuple[int, int]:
    return max(header.width_px, header.height_px), min(header.width_px, header.height_px)


def stray_warnings(left_out: Sequence[Stray]) -> list[Warn]:
    """One line for each kind of stray."""
    out = []
    for code, words in _WORDS.items():
        names = [o.name for c, o in left_out if c == code]
        if names:
            few = f" ({len(names)}: {some(names)})" if len(names) > 1 else ""
            fix = "put them into a folder of their own to map them" if code in _APART else _KEEP
            out.append(Warn(code, names[0] if len(names) == 1 else "", f"left out: {words}{few}; {fix}"))
    return out


def other_kinds(headers: Sequence[FrameHeader], camera: str | None = None) -> list[Stray]:
    """Frames of other bands or pixels, or of another of the aircraft's cameras, than the kind that counts.
    That is the kind with most files among those of the camera asked for. Of kinds with more than half as many
    files, it is the one with most pixels.

    Args: camera: one of `camera_kind`.
    Raises: `InputError` where no frame is of that camera.
    """
    kinds, pixels = Counter(map(_kind_of, headers)), Counter[tuple[int, str, str]]()
    for h in headers:
        pixels[_kind_of(h)] += h.width_px * h.height_px
    there = [kind for kind in kinds if camera is None or kind[2] == camera]
    if not there:
        named = ", ".join(sorted({kind[2] for kind in kinds if kind[2]})) or "none"
        raise InputError(
            f"no frame is of the camera '{camera}' (by the tag ImageSource there are: {named})",
            fix="give --camera-kind one of these, or leave it out",
        )
    most = max(kinds[kind] for kind in there)
    many = [kind for kind in there if 2 * kinds[kind] > most]
    usual = max(many, key=lambda kind: (pixels[kind], kind[2] == "wide", kind))
    out = []
    for h in headers:
        alike, its = _kind_of(h)[:2] == usual[:2], camera_kind(h)
        if its != usual[2] and (its or alike):
            text = f"is of the {its or 'unnamed'} camera, the mosaic of the {usual[2] or 'unnamed'} one"
            out.append(_out("frame-other-camera", h, text))
        elif not alike:
            text = f"has {bands_and_type(h.bands, h.dtype)}, the mosaic's frames {bands_and_type(*usual[:2])}"
            out.append(_out("frame-other-bands", h, text))
    return out


def _kind_of(header: FrameHeader) -> tuple[int, str, str]:
    return header.bands, header.dtype, camera_kind(header)


def camera_kind(header: FrameHeader) -> str:
    """Which of the aircraft's cameras took the frame: wide, zoom, thermal, ms (all bands of a multispectral
    one), or what DJI's tag names it; empty without the tag."""
    source = (header.xmp or {}).get("drone-dji:ImageSource", "").lower().removesuffix("camera").rstrip("_ ")
    return "thermal" if source.startswith("infra") else BANDS if source.startswith("ms_") else source


def copies(headers: Sequence[FrameHeader], looks: Sequence[FrameAppearance | None]) -> list[Stray]:
    """Files of equal bytes, and the same capture under another name or in another size, of which the largest
    is kept. Captures are the same by camera, time and place, and by what they look like."""
    same: dict[object, list[int]] = {}
    for i, header in enumerate(headers):
        same.setdefault(header.path.stat().st_size, []).append(i)
    groups = [g for alike in same.values() if len(alike) > 1 for g in _of_equal_bytes(headers, alike)]
    captures: dict[object, list[int]] = {}
    for i, (header, look) in enumerate(zip(headers, looks, strict=True)):
        e = header.exif
        if e.time_s is not None and look is not None:
            captures.setdefault((label(header), e.time_s, e.lon_deg, e.lat_deg), []).append(i)
    out: dict[int, int] = {}
    for group in groups:
        first, *others = sorted(group, key=lambda i: _own_name(headers[i]))
        out |= dict.fromkeys(others, first)
    for group in captures.values():
        kept: list[int] = []
        for i in sorted(group, key=lambda i: (-headers[i].width_px, _own_name(headers[i]))):
            if i in out:
                continue
            of = next((j for j in kept if _alike(looks[i], looks[j])), None)
            if of is None:
                kept.append(i)
            else:
                out[i] = of
    text = "is the same image as {}"
    return [_out("frame-copy", headers[i], text.format(headers[j].name)) for i, j in sorted(out.items())]


def _own_name(header: FrameHeader) -> tuple[object, ...]:
    """Copies have longer names than what they are copies of."""
    return len(header.name), natural_key(header.name)


def _of_equal_bytes(headers: Sequence[FrameHeader], alike: Sequence[int]) -> list[list[int]]:
    found: dict[bytes, list[int]] = {}
    for i in alike:
        with headers[i].path.open("rb") as file:
            found.setdefault(hashlib.file_digest(file, "sha256").digest(), []).append(i)
    return [g for g in found.values() if len(g) > 1]


def _alike(one: FrameAppearance | None, other: FrameAppearance | None) -> bool:
    if one is None or other is None:
        return False
    a, b = one.small.astype(np.float64), other.small.astype(np.float64)
    if abs(a.mean() - b.mean()) > _COPY_GREYS or abs(a.std() - b.std()) > _COPY_GREYS:
        return False
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return size > 0.0 and float((a * b).sum()) > COPY.value * size


def misplaced(headers: Sequence[FrameHeader], positions: Sequence[Position]) -> list[Stray]:
    """Frames of another flight, or taken during take-off or landing; in order of capture."""
    lonlat = np.array([[p.lon_deg, p.lat_deg] for p in positions])
    known = np.array([p.known for p in positions])
    out: dict[int, Stray] = {}
    from_middle_m = away_m(positions)
    for i in np.flatnonzero(from_middle_m > TOO_FAR_M).tolist():
        known[i] = False
        text = f"lies {from_middle_m[i] / 1000.0:.0f} km from the middle of the survey"
        out[i] = _out("frame-far-away", headers[i], text)
    for i, apart_m in _other_flights(lonlat, known).items():
        text = f"belongs to another flight, {apart_m / 1000.0:.1f} km away"
        out[i] = _out("frame-other-place", headers[i], text)
    rest = np.array([i for i in range(len(headers)) if i not in out], dtype=np.intp)
    above = _heights_above_ground_m([positions[i] for i in rest])
    for k in np.flatnonzero(_low_at_ends(above)):
        text = f"was taken {above[k]:.0f} m above the ground, the others at {np.nanmedian(above):.0f} m"
        out[int(rest[k])] = _out("frame-take-off", headers[rest[k]], text)
    return [out[i] for i in sorted(out)]


def _heights_above_ground_m(positions: Sequence[Position]) -> Floats:
    """As reported, else by the absolute height over the ground that the others show: on the ground, tags say
    0, which counts as not reported."""
    above = np.array([p.height_above_ground_m for p in positions], dtype=np.float64)
    absolute = np.array([p.height_ellipsoidal_m for p in positions], dtype=np.float64)
    both = np.isfinite(above) & np.isfinite(absolute)
    if 2 * both.sum() < len(positions):
        return above
    return np.where(np.isfinite(above), above, absolute - float(np.median((absolute - above)[both])))


def _low_at_ends(above_m: Floats) -> Bools:
    """Frames far below the usual height, in one run from the first frame on or up to the last."""
    out = np.zeros(len(above_m), dtype=bool)
    known = above_m[np.isfinite(above_m)]
    if len(known) < 2 * LEAST_FRAMES:
        return out
    usual = float(np.median(known))
    low = above_m < LOW.value * usual
    most = max(int(FEW * len(above_m)), min(LEAST_FRAMES, len(above_m) // 4))
    spread = NORMAL_PER_MAD * float(np.median(np.abs(known - usual)))
    if SPREADS.value * spread > usual:  # no usual height: hand-flown, or heights that drift
        return out
    for way in (1, -1):
        run = int(np.argmin(np.append(low[::way], False)))
        if run <= most:
            out[::way][:run] = True
    return out


def _other_flights(lonlat: Floats, known: Bools) -> dict[int, float]:
    """Frames of flights apart from the largest by more than both reach, and how far (m)."""
    at = np.flatnonzero(known)
    if len(at) < 2 * LEAST_FRAMES:
        return {}
    en = mid_latitude_offset_m(*lonlat[at[0]], *lonlat[at].T)
    typical = float(np.median(cKDTree(en).query(en, k=2)[0][:, 1]))
    cells, cell = np.unique(np.floor(en / max(_NEAR_M, 10.0 * typical)), axis=0, return_inverse=True)
    adjacent = cKDTree(cells).sparse_distance_matrix(cKDTree(cells), 1.5)
    _, of_cell = connected_components(adjacent, directed=False)
    part = of_cell[cell.ravel()]
    sizes = np.bincount(part)
    main = int(sizes.argmax())
    here = en[part == main]
    out: dict[int, float] = {}
    for k in np.flatnonzero(sizes >= LEAST_FRAMES):
        there = en[part == k]
        gap_m = float(cKDTree(here).query(there)[0].min())
        extent_m = max(float(np.linalg.norm(np.ptp(e, axis=0))) for e in (here, there))
        flown = float(np.ptp(there, axis=0).max()) > typical  # else a receiver that kept its last fix
        if k != main and flown and gap_m > max(APART.value * extent_m, _NEAR_M):
            out |= dict.fromkeys(at[part == k].tolist(), gap_m)
    return out


def blurred(headers: Sequence[FrameHeader], looks: Sequence[FrameAppearance | None]) -> list[Stray]:
    """Frames with far less fine detail, against their coarse, than those before and after, which are sharp;
    in order of capture. Each is covered by its neighbours: of two in a row none is left out."""
    detail = np.array([np.nan if look is None else look.detail for look in looks])
    n = len(detail)
    if np.isfinite(detail).sum() < 2 * LEAST_FRAMES:
        return []
    reach = NEIGHBOURS // 2
    neighbours = [[j for j in range(max(0, i - reach), min(n, i + reach + 1)) if j != i] for i in range(n)]
    lack = np.array([np.nanmedian(detail[b]) if np.isfinite(detail[b]).any() else np.nan for b in neighbours])
    lack -= detail
    off = np.abs(lack - np.nanmedian(lack))
    limit = max(BLURRED.value, SPREADS.value * NORMAL_PER_MAD * float(np.nanmedian(off)))
    blurry = lack > limit
    blurry[1:-1] &= ~(blurry[:-2] | blurry[2:])
    alone = [i for i in np.flatnonzero(blurry).tolist() if 0 < i < n - 1]
    text = "has {:.0f} % of its neighbours' fine detail"
    return [_out("frame-blurred", headers[i], text.format(100.0 * np.exp(-lack[i]))) for i in alone]


def bands_and_type(bands: int, dtype: str) -> str:
    """`3 bands of uint8`."""
    return f"{bands} band{'s' if bands > 1 else ''} of {dtype}"


def _out(code: str, header: FrameHeader, reason: str) -> Stray:
    return code, UnusedImage(header.name, reason)
