"""The rows of results that bench_scale writes."""

from __future__ import annotations

from typing import Any

from tools.bench.result_rows import ResultRow, RowKind
from tools.docs.results_page import FAST

ROWS = {
    "time": RowKind(
        FAST,
        "time a frame, {most:,} frames over {fewest:,}",
        "{target:g}",
        "{growth:.2f}",
    ),
    "processors": RowKind(
        FAST,
        "time of the processors a frame, {most:,} frames over {fewest:,}",
        "{target:g}",
        "{growth:.2f} ({most_s:.1f} s and {fewest_s:.1f} s)",
    ),
    "tied": RowKind(
        FAST,
        "{most:,} frames of 0.3 MP from pixels: frames tied",
        "all",
        "{tied:,}",
    ),
    "memory": RowKind(
        FAST,
        "{most:,} frames of 0.3 MP: peak memory of all processes",
        "{target:g} GB (for 5,000)",
        "{peak_gb:.2f} GB",
    ),
    "disk": RowKind(
        FAST,
        "{most:,} frames of 0.3 MP: run folder over the raw mosaic",
        "{target:g}",
        "{disk:.1f}",
    ),
    "plan": RowKind(
        FAST,
        "{windows:,} windows over {frames:,} frames planned",
        "{target:g} s",
        "{seconds:.1f} s",
    ),
}


def result_rows(results: dict[str, Any]) -> list[ResultRow]:
    """The rows of a bench's results."""
    targets, runs, planned = results["targets"], results["runs"], results["plan"]
    first, last, rows = runs[0], runs[-1], []
    if len(runs) > 1:
        counts = {"most": last["frames"], "fewest": first["frames"], "target": targets["growth"]}
        wall = results["growth"]["wall"]
        rows.append(ROWS["time"].row(wall <= targets["growth"], growth=wall, **counts))
        processors = results["growth"]["processors"]
        seconds = {f"{k}_s": r["processor_s"] / r["frames"] for k, r in (("most", last), ("fewest", first))}
        met = processors <= targets["growth"]
        rows.append(ROWS["processors"].row(met, growth=processors, **seconds, **counts))
    most, tied, peak_gb, disk = last["frames"], last["tied"], last["peak_mb"] / 1e3, last["disk"]
    rows += [
        ROWS["tied"].row(tied == most, most=most, tied=tied),
        ROWS["memory"].row(
            peak_gb <= targets["peak_gb"], most=most, peak_gb=peak_gb, target=targets["peak_gb"]
        ),
        ROWS["disk"].row(disk <= targets["disk"], most=most, disk=disk, target=targets["disk"]),
    ]
    if planned:
        took_s, most_s = sum(planned["seconds"].values()), targets["plan_s"]
        counts = {"windows": planned["windows"], "frames": planned["frames"]}
        rows.append(ROWS["plan"].row(took_s <= most_s, seconds=took_s, target=most_s, **counts))
    return rows
