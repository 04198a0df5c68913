"""`geomosaic compare`: what changed between two runs of one place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomosaic.cli.options import AsJson, Quiet, output_option
from geomosaic.errors import FileError, OutputError

if TYPE_CHECKING:
    from geomosaic.pipeline.run_folder import RunFolder
    from geomosaic.quality.changes import Change, Registration, SurfaceRasters

POLYGONS, PICTURE = "changes.gpkg", "changes.png"


def compare(
    old: Annotated[Path, typer.Argument(help="folder of the earlier run", metavar="RUN1")],
    new: Annotated[Path, typer.Argument(help="folder of the later run", metavar="RUN2")],
    output: Annotated[
        Path | None, output_option("folder to write to [next to the later run: RUN2-changes]")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find what changed between two runs of one place.

    Differences of the images, and of the heights if both runs have a surface, count where they exceed what
    the accuracy of both maps explains. What both maps are off by in common does not count.
    """
    from geomosaic.cli.progress import progress
    from geomosaic.export.changes import write_picture, write_polygons
    from geomosaic.pipeline import files
    from geomosaic.pipeline.run_results import read_summary
    from geomosaic.quality.changes import height_changes, image_changes, registration
    from geomosaic.quality.compare import compare as compared
    from geomosaic.requests.run_request import default_folder

    runs = old, new
    summaries = [read_summary(run) for run in runs]
    before, after = (_mosaic(run) for run in runs)
    made = _results(files.make_folder(output or default_folder(new, "changes")))
    with progress(quiet=quiet or as_json) as reporter:
        reporter.stage_started(0, 1, "Compare")
        comparison = compared(
            after, before, progress=lambda done, of: reporter.progress(done, of, "registered")
        )
        on_old = registration(comparison)
        changes = [*image_changes(before, after, on_old)]
        surfaces = [_surface(run) for run in runs]
        offset_m = None
        if surfaces[0] is not None and surfaces[1] is not None:
            heights, offset_m = height_changes(surfaces[0], surfaces[1], on_old, comparison.gsd_m)
            changes += heights
    with made.writing(POLYGONS) as path:
        write_polygons(path, changes, comparison.crs, None)
    with made.writing(PICTURE) as path:
        write_picture(path, after, changes)
    found = _summary(changes, on_old, comparison.gsd_m, offset_m) | _explained(on_old, offset_m, summaries)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    for line in _lines(found, made.path):
        print(line)


def _results(folder: Path) -> RunFolder:
    """The folder, whose results may be replaced. Raises `OutputError` where one is not geomosaic's."""
    from geomosaic.pipeline.run_folder import RunFolder

    made = RunFolder(folder)
    try:
        for name in (POLYGONS, PICTURE):
            made.claim(name)
    except OutputError as error:
        error.reword(lambda text: text.replace(", or allow it with --overwrite", " with -o"))
        raise
    return made


def _mosaic(run: Path) -> Path:
    path = run / "mosaic.tif"
    if not path.is_file():
        raise FileError(
            "the run has no mosaic.tif", file=run, fix="give the folder of a finished run of frames"
        )
    return path


def _surface(run: Path) -> SurfaceRasters | None:
    from geomosaic.quality.changes import SurfaceRasters

    files = SurfaceRasters(run / "surface.tif", run / "surface_confidence.tif")
    return files if files.surface.is_file() and files.confidence.is_file() else None


def _summary(
    changes: list[Change], on_old: Registration, gsd_m: float, offset_m: float | None
) -> dict[str, Any]:
    of = [
        {
            "kind": c.kind,
            "area_m2": c.area_m2,
            "deviations": c.sigma,
            "rise_m": None if c.rise_m != c.rise_m else c.rise_m,
            "volume_m3": None if c.volume_m3 != c.volume_m3 else c.volume_m3,
            "centre": [c.outline.centroid.x, c.outline.centroid.y],
        }
        for c in changes
    ]
    return {
        "changes": of,
        "apart_m": on_old.shift_m,
        "apart_px": on_old.shift_m / gsd_m,
        "registration_sd_px": on_old.sd_px,
        "height_offset_m": offset_m,
    }


def _explained(
    on_old: Registration, offset_m: float | None, summaries: list[dict[str, Any]]
) -> dict[str, Any]:
    """Deviations of both maps together, and whether their shift is within three of these."""
    absolute = [(s.get("accuracy") or {}).get("absolute") or {} for s in summaries]
    plan, height = (
        sum((a.get(name) or 0.0) ** 2 for a in absolute) ** 0.5 for name in ("rmse_h_m", "rmse_v_m")
    )
    return {
        "accuracy_m": plan or None,
        "apart_is_explained": not plan or on_old.shift_m <= 3.0 * plan,
        "height_accuracy_m": height or None,
        "height_offset_is_explained": offset_m is None or not height or abs(offset_m) <= 3.0 * height,
    }


def _lines(found: dict[str, Any], folder: Path) -> list[str]:
    changes = found["changes"]
    out = []
    for kind in ("image", "height"):
        of = [c for c in changes if c["kind"] == kind]
        area = sum(c["area_m2"] for c in of)
        if kind == "image" or found["height_offset_m"] is not None:
            out.append(f"{kind:<10} {len(of)} changes, {area:.1f} m2")
    why = "" if found["apart_is_explained"] else ", more than the accuracy of both explains: add --coregister"
    out.append(
        f"maps       {found['apart_m']:.2f} m ({found['apart_px']:.1f} px) apart{why}; then equal to "
        f"{found['registration_sd_px']:.2f} px"
    )
    if found["height_offset_m"] is not None:
        why = "" if found["height_offset_is_explained"] else ", more than the accuracy of both explains"
        out.append(
            f"heights    {found['height_offset_m']:+.2f} m apart in common{why}; not counted as a change"
        )
    return [*out, f"written    {folder / POLYGONS}, {folder / PICTURE}"]
