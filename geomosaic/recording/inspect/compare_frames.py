"""What differs between the frames and pairs of two recordings: places, heights, angles, residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.quality import ranking
from geomosaic.recording.inspect.solved import Solved, known, pair_figures

_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")


def frames(a: Solved, b: Solved) -> list[dict[str, Any]]:
    """Frames that b places otherwise than a, by how far and then by how much turned, worst first; frames of
    one alone come before all others."""
    at_a, at_b = _poses(a), _poses(b, a)
    out: list[dict[str, Any]] = []
    for name in dict.fromkeys([*at_a, *at_b]):
        if name not in at_a or name not in at_b:
            out.append({"frame": name, "only_in": "a" if name in at_a else "b"})
            continue
        (status_a, pose_a), (status_b, pose_b) = at_a[name], at_b[name]
        change = pose_b - pose_a
        change[3:] = (change[3:] + 180.0) % 360.0 - 180.0
        if np.array_equal(pose_a, pose_b, equal_nan=True) and status_a == status_b:
            continue
        values = zip(("d_east_m", "d_north_m", "d_up_m", *(f"d_{n}" for n in _ANGLES)), change, strict=True)
        row: dict[str, Any] = {"frame": name, **{n: known(v) for n, v in values}}
        row["moved_m"] = known(float(np.linalg.norm(change[:3])))
        if status_a != status_b:
            row["status"] = [status_a, status_b]
        out.append(row)

    order = ranking.worst_frames(
        ["only_in" in row for row in out],
        ["status" in row for row in out],
        np.array([row.get("moved_m") for row in out], dtype=np.float64),
        [max((abs(row.get(f"d_{n}") or 0.0) for n in _ANGLES), default=0.0) for row in out],
    )
    return [out[i] for i in order]


def pairs(a: Solved, b: Solved) -> list[dict[str, Any]]:
    """Pairs with other residuals, other numbers of tie points, or none, as [of a, of b]. The largest change
    of the residual comes first, after those pairs that one of both alone ties."""
    of_a, of_b = ({(p["left"], p["right"]): p for p in pair_figures(s) if p["tied"]} for s in (a, b))
    out: list[dict[str, Any]] = []
    for key in dict.fromkeys([*of_a, *of_b]):
        both = of_a.get(key), of_b.get(key)
        row: dict[str, Any] = {"left": key[0], "right": key[1]}
        if both[0] is None or both[1] is None:
            out.append(row | {"tied_only_in": "b" if both[0] is None else "a"})
            continue
        change = {
            n: [p[n] for p in both if p is not None] for n in ("rms_m", "tie_points", "share_down_weighted")
        }
        change = {n: v for n, v in change.items() if v[0] != v[1]}
        if change:
            out.append(row | change)

    rms_m = [[v or 0.0 for v in row.get("rms_m", (0.0, 0.0))] for row in out]
    changes = [
        np.inf if "tied_only_in" in row else abs(b - a) for row, (a, b) in zip(out, rms_m, strict=True)
    ]
    return [out[i] for i in ranking.worst_pairs(changes)]


def places_m(a: Solved, b: Solved) -> tuple[list[str], Floats, Floats]:
    """The frames that both have, and where a and b place them, (n, 2) each: east, north in a's work frame."""
    at_a, at_b = _poses(a), _poses(b, a)
    both = [name for name in at_a if name in at_b]
    from_m, to_m = (np.array([at[n][1][:2] for n in both]).reshape(-1, 2) for at in (at_a, at_b))
    return both, from_m, to_m


def _poses(solved: Solved, frame_of: Solved | None = None) -> dict[str, tuple[str, Floats]]:
    """Of each frame its status, and east, north, up (m) and yaw, pitch, roll (deg), (6,), in the work frame
    of `frame_of`; the given ones where it wasn't adjusted."""
    of = solved.found or solved.given
    if of is None:
        return {}
    placed = solved.adjusted or solved.prior
    assert placed is not None
    at_m = placed.poses.positions_m
    if frame_of is not None and not is_local(solved.survey.map_crs):
        other = frame_of.survey.work_frame
        if other != solved.survey.work_frame:
            at_m = other.enu_from_geodetic(*of.lon_lat_height.T)
    values = np.concatenate([at_m, of.yaw_pitch_roll_deg], axis=1)
    status = solved.adjusted.status if solved.adjusted is not None else ("not adjusted",) * len(values)
    out = {n: (s, v) for n, s, v in zip(solved.names, status, values, strict=True)}
    nothing = np.full(6, np.nan)
    return out | {left.name: ("left_out", nothing) for left in solved.survey.left_out}
