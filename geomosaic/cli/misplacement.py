"""`geomosaic misplacement`: how many scenes of strips are no good, as the paper's table 1 counts them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

from geomosaic.cli.options import AsJson
from geomosaic.errors import InputError


@dataclass(frozen=True)
class _Scene:
    """A run's figures; `misplaced` as run.json reports it, None where nothing is known."""

    run: str
    method: str
    misplaced: bool | None
    rms_px: float | None
    worst_segment_px: float | None


def misplacement(
    runs: Annotated[
        list[Path], typer.Argument(help="folders of finished runs of `geomosaic strips`", metavar="RUN")
    ],
    as_json: AsJson = False,
) -> None:
    """Show which scenes of strips are misplaced by more than 1 px.

    Also shows the share of misplaced scenes for each method.
    """
    from geomosaic.quality.strip_figures import misplacement_rate

    scenes = [_scene(run) for run in runs]
    methods = sorted({s.method for s in scenes})
    rates = {m: asdict(misplacement_rate([s.misplaced for s in scenes if s.method == m])) for m in methods}
    if as_json:
        plain = {m: {k: v if isfinite(v) else None for k, v in rate.items()} for m, rate in rates.items()}
        print(json.dumps({"scenes": [asdict(s) for s in scenes], "rates": plain}, indent=2))
        return
    for s in scenes:
        verdict = {True: "misplaced", False: "in place", None: "unknown"}[s.misplaced]
        print(
            f"{s.run}: {verdict}, {_px(s.rms_px)} RMS, worst segment {_px(s.worst_segment_px)} ({s.method})"
        )
    for method, rate in rates.items():
        known = (
            f"{rate['misplaced']} of {rate['scenes']} misplaced, {100 * rate['rate']:.1f} % "
            f"(95 % interval {100 * rate['low']:.1f} to {100 * rate['high']:.1f} %)"
        )
        unknown = f"{rate['unknown']} unknown"
        parts = [known] * bool(rate["scenes"]) + [unknown] * bool(rate["unknown"])
        print(f"{method}: {', '.join(parts)}")


def _scene(run: Path) -> _Scene:
    from geomosaic.pipeline.run_results import read_summary

    metrics: dict[str, Any] = read_summary(run)["metrics"]
    figures = metrics.get("misplacement")
    if not isinstance(figures, dict) or not isinstance(figures.get("misplaced", ""), bool | None):
        raise InputError(
            "reports no misplacement", file=run / "run.json", fix="give runs of `geomosaic strips`"
        )
    method = str(metrics.get("offsets", {}).get("method", ""))
    return _Scene(
        str(run), method, figures["misplaced"], figures.get("rms_px"), figures.get("worst_segment_px")
    )


def _px(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} px"
