"""Stages over time, and steps of the solves with cost and sigma, drawn so that any timeline shows them."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import printable
from geomosaic.recording.rerun.plan_view import ui

STAGES: Final = "/stages_drawn"
STEPS: Final = "/steps_drawn"
SPECTRUM: Final = "/spectrum_drawn"
_WIDE, _HIGH, _ROW = 300.0, 100.0, 34.0
_NAMES: Final = 260.0
_LEAST_SHARE: Final = 0.004
"""Of a run's time: shorter stages aren't drawn."""
BOUNDS: Final = {
    STAGES: ((-_NAMES, _WIDE + 10.0), (-_ROW, 13.0 * _ROW)),
    STEPS: ((-60.0, _WIDE + 60.0), (-45.0, _HIGH + 60.0)),
    SPECTRUM: ((-20.0, _WIDE + 260.0), (-10.0, _HIGH + 20.0)),
}
"""What views show of each, x and y: names are as large at any scale and need room."""
_BAR, _REUSED, _OPEN = (80, 140, 210), (90, 95, 110), (255, 90, 60)
_COST, _SIGMA, _AXIS = (235, 150, 60), (90, 190, 250), (90, 95, 110)


def draw_stages(recording: Recording, stream: Any) -> None:
    """A bar for each stage from its beginning to its end; one that didn't end in red, to the last message."""
    import rerun

    if not recording.stages:
        return
    begin_ns = recording.stages[0].begun_ns
    total_ns = max(recording.last_ns - begin_ns, 1)
    least_ns = _LEAST_SHARE * total_ns
    bars: list[Any] = []
    places, colours, labels = [], [], []
    for stage in recording.stages:
        end_ns = stage.ended_ns or recording.last_ns
        if stage.ended_ns and end_ns - stage.begun_ns < least_ns:
            continue
        left, right = ((t - begin_ns) / total_ns * _WIDE for t in (stage.begun_ns, end_ns))
        y = len(bars) * _ROW
        bars.append([[left, y], [max(right, left + 1.0), y]])
        places.append([-_NAMES / 2.0, y])
        colours.append(_OPEN if not stage.ended_ns else _REUSED if stage.cached else _BAR)
        seconds = (end_ns - stage.begun_ns) / 1e9
        labels.append(
            f"{printable(stage.stage_id)}  {seconds:.1f} s{'' if stage.ended_ns else ', not finished'}"
        )
    stream.log(f"{STAGES}/bars", rerun.LineStrips2D(bars, colors=colours, radii=ui(4.0)), static=True)
    named = rerun.Points2D(places, labels=labels, show_labels=True, colors=colours, radii=ui(0.5))
    stream.log(f"{STAGES}/names", named, static=True)


def draw_steps(recording: Recording, stream: Any) -> None:
    """Cost and sigma of each step, each in powers of ten between its own least and largest."""
    import rerun

    steps = recording.iterations
    if not steps:
        return
    cost, sigma = (np.array([s[name] for s in steps], dtype=np.float64) for name in ("cost", "sigma_px"))
    unit = steps[-1]["cost_unit"]
    stream.log(f"{STEPS}/axes", rerun.LineStrips2D([_FRAME], colors=[_AXIS], radii=ui(0.5)), static=True)
    for k, (name, values, colour) in enumerate((("cost", cost, _COST), ("sigma_px", sigma, _SIGMA))):
        line, text = _curve(values, name if name != "cost" or not unit else f"misalignment rms, {unit}")
        stream.log(f"{STEPS}/{name}", rerun.LineStrips2D(line, colors=[colour], radii=ui(1.2)), static=True)
        at = [[_WIDE / 2.0, -14.0 - 22.0 * k]]
        label = rerun.Points2D(at, labels=[text], show_labels=bool(text), colors=[colour], radii=ui(0.5))
        stream.log(f"{STEPS}/{name}_name", label, static=True)
    solves = [s["solve"] for s in steps]
    starts = [k for k, name in enumerate(solves) if k == 0 or name != solves[k - 1]]
    x = _along(len(solves))[starts]
    stream.log(
        f"{STEPS}/solves",
        rerun.Points2D(
            np.column_stack([x, _HIGH + 12.0 + 22.0 * np.arange(len(x))]),
            labels=[f"{k + 1}: {printable(solves[k])}" for k in starts],
            show_labels=True,
            colors=[_AXIS],
            radii=ui(1.5),
        ),
        static=True,
    )


def draw_spectra(recording: Recording, stream: Any) -> None:
    """Amplitudes of what strips move by, as found and as left, both axes logarithmic."""
    import rerun

    known = {s.what: s for s in recording.jitter if len(s.frequency_hz)}
    if not known:
        return
    colours = {"found": ((90, 170, 250), (130, 200, 90)), "left": ((235, 110, 60), (240, 190, 90))}
    every = np.concatenate([np.concatenate([s.across_px, s.along_px]) for s in known.values()])
    low = max(float(every.max()) / 1e4, 1e-6)
    hz = np.concatenate([s.frequency_hz for s in known.values()])
    span = np.log10([max(float(hz.min()), 1e-6), max(float(hz.max()), 2e-6)])
    top = np.log10(max(float(every.max()), 10.0 * low))
    stream.log(f"{SPECTRUM}/axes", rerun.LineStrips2D([_FRAME], colors=[_AXIS], radii=ui(0.5)), static=True)
    for i, (what, s) in enumerate(known.items()):
        x = (np.log10(np.maximum(s.frequency_hz, 1e-6)) - span[0]) / max(np.ptp(span), 1e-9) * _WIDE
        for j, (axis, values) in enumerate((("across", s.across_px), ("along", s.along_px))):
            y = (top - np.log10(np.maximum(values, low))) / (top - np.log10(low)) * _HIGH
            colour = colours.get(what, colours["found"])[j]
            line = rerun.LineStrips2D([np.column_stack([x, y])], colors=[colour], radii=ui(1.0))
            stream.log(f"{SPECTRUM}/{what}_{axis}", line, static=True)
            text = f"{what} {axis}, largest {max(values):.2g} px"
            at = [[_WIDE + 130.0, 10.0 + 26.0 * (2 * i + j)]]
            label = rerun.Points2D(at, labels=[text], show_labels=True, colors=[colour], radii=ui(0.5))
            stream.log(f"{SPECTRUM}/{what}_{axis}_name", label, static=True)
    ends = [f"{10**v:.3g} Hz" for v in span]
    label = rerun.Points2D(
        [[0, _HIGH + 6], [_WIDE, _HIGH + 6]], labels=ends, show_labels=True, colors=[_AXIS]
    )
    stream.log(f"{SPECTRUM}/ends", label, static=True)


_FRAME: Final = [[0.0, 0.0], [0.0, _HIGH], [_WIDE, _HIGH], [_WIDE, 0.0], [0.0, 0.0]]


def _along(count: int) -> Floats:
    return np.linspace(0.0, _WIDE, count) if count > 1 else np.array([_WIDE / 2.0])


def _curve(values: Floats, name: str) -> tuple[list[Floats], str]:
    """Pieces of a curve in the frame, and what it goes from and to."""
    good = np.isfinite(values) & (values > 0.0)
    if not good.any():
        return [], ""
    logs = np.log10(np.where(good, values, np.nan))
    low, high = float(np.nanmin(logs)), float(np.nanmax(logs))
    y = _HIGH - (logs - low) / max(high - low, 1e-9) * _HIGH
    points = np.column_stack([_along(len(values)), y])[good]
    first, last = values[good][0], values[good][-1]
    return [points if len(points) > 1 else np.repeat(points, 2, axis=0)], f"{name}: {first:.3g} to {last:.3g}"
