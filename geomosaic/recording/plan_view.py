"""The plan in Rerun: metres in the work frame, north up, nothing from any network."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.recording.story import Story, ToldTable

Floats = NDArray[np.float64]
Colours = NDArray[np.uint8]
PLAN: Final = "/plan"
NAME: Final = (
    "plan, m: thick arrows from POS to adjusted, lines and dots: pairs and tie points by residual, green to "
    "red; grey: tried, not tied; white: picked frame"
)
_GREY, _FAINT, _RED = (95, 95, 110), (60, 66, 80), (255, 60, 60)
_MOST_LABELS: Final = 150
FAR: Final = 5.0
"""Times the median move beyond which a frame's is named: of normal errors one frame in 10,000 is."""
_QUIET: Final = 0.25
"""Ground pixels: residuals up to that are called usual, however small all others are."""
HEADING_OFF_DEG: Final = 30.0
"""From which a heading is said to be off: no sensor is that bad, a wrong tag is."""


def draw_plan(story: Story, stream: Any) -> None:
    """Draws what is known so far, over what was drawn before."""
    import rerun

    placed, adjusted = story.table("frames.placed"), story.table("frames.adjusted")
    for what, colour, width in (
        ("placed", _FAINT, 0.6),
        ("adjusted", (80, 110, 160), 0.8),
        ("seams", _FAINT, 0.6),
    ):
        rings = [
            _drawn(np.concatenate([ring, ring[:1]])) for _, ring in story.outlines.get(what, ()) if len(ring)
        ]
        lines = rerun.LineStrips2D(rings, colors=[colour], radii=_ui(width / 2), draw_order=1.0)
        stream.log(f"{PLAN}/footprints_{what}" if what != "seams" else f"{PLAN}/seams", lines, static=True)
    now = adjusted if adjusted.row else placed
    if not now.row:
        return
    at, number = _drawn(_places(now)), now.number
    _draw_pairs(story, stream, at, number)
    _draw_ties(story, stream)
    if adjusted.row:
        _draw_moves(stream, adjusted, at)
    labels, colours = frame_labels(placed, adjusted), frame_colours(now)
    odd = [k for k, label in enumerate(labels) if " " in label]
    every = list(range(len(labels))) if len(labels) <= _MOST_LABELS else odd
    points = rerun.Points2D(at, colors=colours, radii=_ui(3.5), draw_order=5.0)
    stream.log(f"{PLAN}/frames", points, static=True)
    named = rerun.Points2D(
        at[every],
        colors=colours[every],
        radii=_ui(1.0),
        labels=[labels[k] for k in every],
        show_labels=True,
        draw_order=6.0,
    )
    stream.log(f"{PLAN}/names", named, static=True)


def _draw_pairs(story: Story, stream: Any, at: Floats, number: dict[str, int]) -> None:
    import rerun

    tried, tied = story.table("pairs.tried"), story.table("pairs.adjusted")
    vain = [
        at[[number[a], number[b]]]
        for a, b, why in zip(tried.row, tried.other, tried.note, strict=False)
        if why and a in number and b in number
    ]
    lines = rerun.LineStrips2D(vain, colors=[_GREY], radii=_ui(0.4), draw_order=2.0)
    stream.log(f"{PLAN}/pairs_untied", lines, static=True)
    known = [k for k, (a, b) in enumerate(zip(tied.row, tied.other, strict=False)) if {a, b} <= number.keys()]
    rms_m = tied.column("rms_m")[known]
    usual_m = max(_usual(rms_m), _QUIET * _pixel_m(story))
    order = np.argsort(np.nan_to_num(rms_m), kind="stable")
    ends = [at[[number[tied.row[known[k]]], number[tied.other[known[k]]]]] for k in order]
    colours = by_size(rms_m[order], usual_m)
    width = [1.2 if c[0] > 200 and c[1] < 120 else 0.7 for c in colours]
    lines = rerun.LineStrips2D(ends, colors=colours, radii=_ui(np.array(width)), draw_order=3.0)
    stream.log(f"{PLAN}/pairs_tied", lines, static=True)


def _draw_ties(story: Story, stream: Any) -> None:
    import rerun

    sample = story.table("ties.ground")
    residual_m = sample.column("residual_m")
    at = _drawn(_places(sample))
    usual_m = max(_usual(residual_m), _QUIET * _pixel_m(story))
    points = rerun.Points2D(at, colors=by_size(residual_m, usual_m), radii=_ui(0.9), draw_order=1.5)
    stream.log(f"{PLAN}/tie_points", points, static=True)


def _draw_moves(stream: Any, adjusted: ToldTable, at: Floats) -> None:
    import rerun

    moved = _drawn(np.column_stack([adjusted.column("moved_e_m"), adjusted.column("moved_n_m")]))
    length = np.hypot(*moved.T)
    known = np.isfinite(length)
    arrows = rerun.Arrows2D(
        origins=(at - moved)[known],
        vectors=moved[known],
        colors=by_size(length[known], _usual(length)),
        radii=_ui(1.6),
        draw_order=4.0,
    )
    stream.log(f"{PLAN}/moved", arrows, static=True)


def frame_labels(placed: ToldTable, adjusted: ToldTable) -> list[str]:
    """Names without their endings, and behind a blank what is odd about a frame."""
    if not adjusted.row:
        return [_stem(name) for name in placed.row]
    moved = moves_m(adjusted)
    far = FAR * np.nanmedian(moved) if np.isfinite(moved).any() else np.inf
    off = headings_off_deg(placed, adjusted)
    out = []
    for k, name in enumerate(adjusted.row):
        odd = [f"{moved[k]:.0f} m"] if moved[k] > max(far, 1.0) else []
        odd += [f"heading {off[k]:.0f} deg off"] if off[k] > HEADING_OFF_DEG else []
        status = adjusted.note[k] if adjusted.note else "tied"
        odd += [status] if status != "tied" else []
        out.append(" ".join([_stem(name), ", ".join(odd)]).strip())
    return out


def moves_m(adjusted: ToldTable) -> Floats:
    """How far frames moved over the ground, (n,)."""
    return np.hypot(adjusted.column("moved_e_m"), adjusted.column("moved_n_m"))


def headings_off_deg(placed: ToldTable, adjusted: ToldTable) -> Floats:
    """By how much headings as found differ from those as given, (n,) of the adjusted frames, 0 to 180."""
    given = dict(zip(placed.row, placed.column("yaw_deg"), strict=True))
    before = np.array([given.get(name, np.nan) for name in adjusted.row])
    return np.asarray(np.abs((adjusted.column("yaw_deg") - before + 180.0) % 360.0 - 180.0))


def frame_colours(now: ToldTable) -> Colours:
    """By how far frames moved; red for what isn't tied."""
    moved = moves_m(now)
    colours = (
        by_size(moved, _usual(moved))
        if np.isfinite(moved).any()
        else np.full((len(now.row), 3), 170, np.uint8)
    )
    for k, status in enumerate(now.note):
        if status in ("placed", "rejected"):
            colours[k] = _RED
    return colours


def by_size(values: Floats, usual: float) -> Colours:
    """(n, 3): green for none, yellow for twice the usual, red from four times on; grey for unknown."""
    share = np.clip(np.nan_to_num(values) / max(4.0 * usual, 1e-12), 0.0, 1.0)[:, None]
    green, yellow, red = (np.array(c, dtype=np.float64) for c in ((60, 200, 80), (230, 190, 60), _RED))
    low = green + (yellow - green) * np.minimum(2.0 * share, 1.0)
    mixed = np.where(share > 0.5, yellow + (red - yellow) * (2.0 * share - 1.0), low)
    mixed[~np.isfinite(values)] = _GREY
    return np.asarray(np.round(mixed), dtype=np.uint8)


def _pixel_m(story: Story) -> float:
    """The frames' ground pixel, 0 if it isn't known."""
    known = story.figures.get("placement.ground_pixel_m")
    return float(known) if isinstance(known, int | float) else 0.0


def _usual(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 1.0


def _places(table: ToldTable) -> Floats:
    return np.column_stack([table.column("east_m"), table.column("north_m")])


def _drawn(at_m: Floats) -> Floats:
    """East and north as Rerun draws: down is positive."""
    return np.asarray(at_m[:, :2] * [1.0, -1.0])


def _ui(points: Any) -> Any:
    import rerun

    return rerun.Radius.ui_points(points)


def _stem(name: str) -> str:
    return name.rpartition(".")[0] or name
