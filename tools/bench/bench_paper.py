"""The paper's comparison: all adjustment methods side by side on simulated surveys with known truth.

Three surveys: the nine frames of table 2 of Yue et al. 2021 (doi:10.3788/IRLA20200529), and one line of 30
frames at 20 % and at 60 % overlap. Each is rendered and matched once; position and attitude are then drawn
anew many times, and every draw is adjusted by every method on the same tie points. The nine frames are
drawn at two levels of noise. The first draw is also composed and compared to the true ortho. Ends with exit
code 1 unless `chain` grows along both lines and `error_sharing` does not.
"""

from __future__ import annotations

import argparse
import copy
import datetime
import json
import os
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from osgeo import gdal
from rasterio.windows import Window
from scipy.stats import t as student

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.paper.misalignment import fullest_bin_mean
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.recipe import Recipe, RecipeStep, recipe_from
from geomosaic.pipeline.registry import installed
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.run_options import RunOptions
from geomosaic.pipeline.run_results import load_artefact
from geomosaic.pipeline.runner import run
from geomosaic.pipeline.single_stage import StageInputs, run_stage
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import best_similarity
from geomosaic.quality.misalignment import FramesOverGround, frame_ground_errors, trend
from geomosaic.quality.positions import read_poses
from geomosaic.report.plots import Axis, Series, line_plot
from geomosaic.stages.mosaic_compose import RASTER
from geomosaic.survey.model import Survey
from geomosaic_simulate.flight import Observed, fly, observe
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import SimulatedSurvey, simulate_frames
from geomosaic_simulate.write import pos_rows, write_csv

Floats = NDArray[np.float64]
UNIT_M = 0.1
"""The paper's pixel. Misalignments are counted in it, whatever the frames' own pixel."""
EPSILON_M = 1.0
"""Where error sharing stops: the paper's 10 pixels."""
LONG = "error_sharing, 200 rounds"
COARSE = 8
"""By how much the mosaic is reduced for a look from afar."""
PAPER_SSIM = {"chain": 0.8790, "layered": 0.9001, "base_frame": 0.9121, "error_sharing": 0.9201}
SHOWN = ("none", "chain", "error_sharing", "least_squares", "bundle")


@dataclass(frozen=True)
class PaperCase:
    """A survey to try the methods on. judged: the growth along it decides the exit code. of: the case whose
    frames and tie points it shares, only position and attitude being noisier or better."""

    name: str
    title: str
    plan: SurveyPlan
    judged: bool = False
    of: str = ""


@dataclass
class PaperOutcome:
    """One method on one survey. Lists hold one entry a draw of position and attitude."""

    errors_m: list[Floats] = field(default_factory=list)
    misaligned: list[Floats] = field(default_factory=list)
    tie_rms: list[float] = field(default_factory=list)
    rounds: list[list[float]] = field(default_factory=list)
    ssim: float = float("nan")
    ssim_after: float = float("nan")
    ssim_coarse: float = float("nan")

    def row(self) -> dict[str, Any]:
        """The figures of the table."""
        length = np.linalg.norm(self.errors_m, axis=2)
        slopes = np.array([trend(np.arange(len(e)), e).slope for e in length])
        misaligned = np.linalg.norm(np.concatenate(self.misaligned), axis=1)
        return {
            "ssim": self.ssim,
            "ssim_after_similarity": self.ssim_after,
            "ssim_coarse": self.ssim_coarse,
            "misalignment_mean_px": float(misaligned.mean()),
            "misalignment_max_px": float(misaligned.max()),
            "tie_point_rms_px": float(np.sqrt(np.mean(np.square(self.tie_rms)))),
            "frame_rms_m": float(np.sqrt((length**2).mean())),
            "first_frames_rms_m": float(np.sqrt((length[:, :3] ** 2).mean())),
            "last_frames_rms_m": float(np.sqrt((length[:, -3:] ** 2).mean())),
            "slope_m_per_frame": float(slopes.mean()),
            "slope_sd_m_per_frame": float(slopes.std(ddof=1) / np.sqrt(len(slopes))),
            "rounds_mean": float(np.mean([len(r) for r in self.rounds])),
            "frame_error_m": np.sqrt((length**2).mean(axis=0)).tolist(),
            "misalignment_by_round_px": self.rounds[0],
        }


def cases(seed: int, quick: bool) -> list[PaperCase]:
    """The surveys, smaller for a quick look."""
    base = SurveyPlan(seed=seed, pos_in="csv")
    frames, width, height, scale = (16, 480, 360, 0.1) if quick else (30, 800, 600, 0.2)
    line = replace(
        base, kind="line", frames_per_line=frames, width_px=width, height_px=height, heading_deg=92.0
    )
    nine = replace(base, kind="paper", scale=scale)
    good = replace(nine, position_sd_m=8.0, tilt_sd_deg=0.02, yaw_sd_deg=0.05)
    return [
        PaperCase("nine", "The paper's nine frames", nine),
        PaperCase("nine_shift", "The paper's nine frames, 8 m positions, good attitudes", good, of="nine"),
        *(
            PaperCase(
                f"line{p}",
                f"{frames} frames in one line, {p} % overlap",
                replace(line, forward_overlap=p / 100.0),
                judged=True,
            )
            for p in (20, 60)
        ),
    ]


class Bench:
    """One case: simulated, matched, then adjusted for one draw of position and attitude after another."""

    def __init__(self, case: PaperCase, folder: Path) -> None:
        self.case, self.folder, self.plan = case, folder, case.plan
        self.files: SimulatedSurvey = simulate_frames(folder / "survey", case.plan)
        self.flight = fly(case.plan)
        assert self.files.pos is not None
        recipe = recipe_from(
            {
                "stages": [
                    {"stage": "survey.read", "params": self._read(self.files.pos)},
                    {"stage": "projection.ground", "params": {"height_m": case.plan.ground_height_m}},
                    "placement.pos",
                    {"stage": "matching.sift", "params": {"keypoints": 2500}},
                ]
            },
            installed(),
        )
        summary = run(recipe, folder / "match", RunOptions(workers=os.cpu_count() or 1))
        self.ties: TiePoints = load_artefact(folder / "match", summary, "ties", TiePoints)
        self.outcomes: dict[str, PaperOutcome] = {}

    def with_noise_of(self, case: PaperCase) -> Bench:
        """The same frames and tie points under another noise of position and attitude."""
        other = copy.copy(self)
        other.case, other.plan, other.outcomes = case, case.plan, {}
        return other

    def draw(self, seed: int, compose: bool) -> None:
        """Positions and attitudes of one seed, adjusted by every method, and by the paper's own formulae."""
        observed = observe(replace(self.plan, seed=seed), self.flight)
        inputs = self._placed(f"pos{seed}.csv", observed, {})
        for method in METHODS:
            self._adjust(method, {"method": method}, inputs, compose)
        self._adjust(LONG, {"method": "error_sharing", "max_rounds": 200}, inputs, compose=False)
        params = {"formula": "mid_latitude", "attitude": "phi_omega_kappa"}
        inputs = self._placed(f"pos{seed}_paper.csv", _in_the_papers_angles(observed), params)
        self._adjust("paper.yaml", {"method": "error_sharing"}, inputs, compose)

    def _read(self, pos: Path) -> dict[str, Any]:
        return {
            "frames": self.files.frames,
            "pos": pos,
            "camera": self.files.camera,
            "attitude_convention": "body",
        }

    def _stage(self, id: str, params: dict[str, Any], inputs: dict[str, Any]) -> dict[str, Any]:
        stage = installed().get(id)
        values, _ = run_stage(
            Recipe("", "", 0, (RecipeStep(stage, stage.Params(**params)),)),
            StageInputs(RunFolder(self.folder / "run"), inputs),
            work_folder=self.folder / "work",
        )
        return {**inputs, **values}

    def _placed(self, name: str, observed: Observed, placement: dict[str, Any]) -> dict[str, Any]:
        pos = self.folder / name
        write_csv(pos, *pos_rows(self.plan, observed))
        read = self._stage("survey.read", self._read(pos), {})
        ground = self._stage("projection.ground", {"height_m": self.plan.ground_height_m}, read)
        placed = self._stage("placement.pos", placement, ground)
        return {**placed, "placement": placed["prior_placement"], "ties": self.ties}

    def _adjust(self, name: str, params: dict[str, Any], placed: dict[str, Any], compose: bool) -> None:
        survey: Survey = placed["survey"]
        epsilon_px = EPSILON_M / placed["placement"].ground_pixel_m
        solved = self._stage("adjustment.solve", {"epsilon_px": epsilon_px, **params}, placed)
        adjusted: Adjusted = solved["adjusted"]
        truth = read_poses(self.files.positions, [f.name for f in survey.frames], survey.work_frame)
        cameras = [survey.camera_of(i) for i in range(len(survey.frames))]
        found = FramesOverGround(adjusted.poses, adjusted.cameras, adjusted.ground)
        true = FramesOverGround(truth, cameras, placed["prior_ground"])
        outcome = self.outcomes.setdefault(name, PaperOutcome())
        outcome.errors_m.append(frame_ground_errors(found, true))
        left = [r[np.isfinite(r).all(axis=1)] / UNIT_M for r in adjusted.residuals_m]
        outcome.misaligned.append(np.array([fullest_bin_mean(r) for r in left if len(r)]))
        outcome.tie_rms.append(float(np.sqrt((np.concatenate(left) ** 2).sum(axis=1).mean())))
        outcome.rounds.append([float(np.abs(r.misalignments_m).max() / UNIT_M) for r in adjusted.rounds])
        if compose:
            owned = self._stage("mosaic.seams", {"seam": "nearest_nadir"}, solved)
            self._stage("mosaic.compose", {"sources": False, "blend": "feather"}, owned)
            mosaic = self.mosaic(name)
            (self.folder / "run" / RASTER).replace(mosaic)
            there = _on_map(survey, truth, cameras, placed["prior_ground"])
            here = _on_map(survey, adjusted.poses, adjusted.cameras, adjusted.ground)
            moved = self.folder / "ortho_moved.vrt"
            _follow(self.files.ortho, moved, there, here)
            coarse = self.folder / "coarse.tif"
            share = 100 / COARSE
            gdal.Translate(str(coarse), str(mosaic), widthPct=share, heightPct=share, resampleAlg="average")
            outcome.ssim, outcome.ssim_after, outcome.ssim_coarse = (
                compare(image, ortho, ComparisonOptions(step_px=2048, search_px=8)).ssim.ssim
                for image, ortho in (
                    (mosaic, self.files.ortho),
                    (mosaic, moved),
                    (coarse, self.files.ortho),
                )
            )

    def mosaic(self, name: str) -> Path:
        """Where the mosaic of a method lies."""
        return self.folder / f"{name}.tif"

    def crops(self, names: Sequence[str], side_px: int = 200) -> NDArray[np.uint8]:
        """The same ground two thirds along the line in each mosaic and in the true ortho, pixel for pixel."""
        rows = np.genfromtxt(self.files.positions, delimiter=",", names=True, dtype=None, encoding="utf-8")
        at = 2 * len(rows) // 3
        middle = np.array([[rows[k][i] for k in ("easting_m", "northing_m")] for i in (at - 1, at)])
        panels = []
        for name, path in [*((n, self.mosaic(n)) for n in names), ("true ortho", self.files.ortho)]:
            with rasterio.open(path) as tiff:
                row, col = tiff.index(*middle.mean(axis=0))
                window = Window(col - side_px // 2, row - side_px // 2, side_px, side_px)
                panel = np.moveaxis(tiff.read([1, 2, 3], window=window, boundless=True), 0, -1)
            panels.append(np.vstack([_caption(name, side_px), panel]))
        return np.hstack([np.pad(p, ((0, 0), (0, 4), (0, 0)), constant_values=255) for p in panels])


def _caption(words: str, width_px: int) -> NDArray[np.uint8]:
    strip, font = np.full((22, width_px, 3), 255, np.uint8), cv2.FONT_HERSHEY_SIMPLEX
    return np.asarray(cv2.putText(strip, words, (4, 16), font, 0.5, (0, 0, 0), 1, cv2.LINE_AA))


def _in_the_papers_angles(observed: Observed) -> Observed:
    """The same attitudes as phi, omega and true heading in the columns of pitch, roll and yaw."""
    body = Rotation.from_yaw_pitch_roll(*np.radians(observed.yaw_pitch_roll_deg).T)
    phi, omega, kappa = np.degrees(body.phi_omega_kappa())
    return replace(observed, yaw_pitch_roll_deg=np.column_stack([-kappa % 360.0, phi, omega]))


def _on_map(survey: Survey, poses: Poses, cameras: Sequence[Camera], ground: GroundSurface) -> Floats:
    """Easting and northing of 3 x 3 pixels of each frame."""
    share = np.stack(np.meshgrid([0.1, 0.5, 0.9], [0.1, 0.5, 0.9]), axis=-1).reshape(-1, 2)
    enu = [
        ground_from_image(poses[i], camera, ground, share * [camera.width_px, camera.height_px])
        for i, camera in enumerate(cameras)
    ]
    geodetic = survey.work_frame.geodetic_from_enu(np.concatenate(enu))
    return MapProjection(survey.map_crs).map_from_geodetic(geodetic[:, 0], geodetic[:, 1])


def _follow(ortho: Path, moved: Path, there: Floats, here: Floats) -> None:
    """The ortho under a georeference moved by the similarity that takes true places to the mosaic's."""
    s, _ = best_similarity(there, here - there)
    similarity = (
        Affine.translation(s.centre_east_m + s.shift_east_m, s.centre_north_m + s.shift_north_m)
        * Affine.rotation(np.degrees(s.rotation_rad))
        * Affine.scale(s.scale)
        * Affine.translation(-s.centre_east_m, -s.centre_north_m)
    )
    gdal.UseExceptions()
    with rasterio.open(ortho) as tiff:
        transform = similarity * tiff.transform
    gdal.Translate(str(moved), str(ortho), format="VRT").SetGeoTransform(transform.to_gdal())


COLUMNS = (
    "method", "SSIM", "after similarity", f"SSIM at 1:{COARSE}", "misalignment mean", "max", "tie points",
    "frames RMS (m)", "first 3", "last 3", "slope (mm/frame)", "rounds",
)  # fmt: skip


def table(rows: dict[str, dict[str, Any]]) -> str:
    """The figures as Markdown."""
    lines = [" | ".join(COLUMNS), "|".join("---" for _ in COLUMNS)]
    for name, r in rows.items():
        cells = [name]
        likeness = [r[key] for key in ("ssim", "ssim_after_similarity", "ssim_coarse")]
        cells += [f"{v:.3f}" if np.isfinite(v) else "" for v in likeness]
        cells += [
            f"{r[key]:.1f}" for key in ("misalignment_mean_px", "misalignment_max_px", "tie_point_rms_px")
        ]
        cells += [f"{r[key]:.2f}" for key in ("frame_rms_m", "first_frames_rms_m", "last_frames_rms_m")]
        cells += [f"{1e3 * r['slope_m_per_frame']:+.0f} ± {1e3 * r['slope_sd_m_per_frame']:.0f}"]
        lines.append(" | ".join([*cells, f"{r['rounds_mean']:.1f}"]))
    return "".join(f"| {line} |\n" for line in lines).replace("| ---", "|---").replace("--- |", "---|")


def _rounded(value: Any) -> Any:
    """Plain values for JSON: four significant digits, null for what is not a number."""
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.4g}") if np.isfinite(value) else None
    return value


def plot(title: str, rows: dict[str, dict[str, Any]]) -> str:
    """Error against frame number, one line a method."""
    series = [
        Series(name, np.arange(1, len(r["frame_error_m"]) + 1), r["frame_error_m"], marks=False)
        for name, r in rows.items()
        if name in METHODS
    ]
    x, y = Axis("frame", whole=True), Axis("RMS ground displacement", "m", low=0.0)
    return line_plot(series, x, y, label=title, width=860)


def faults(rows: dict[str, dict[str, Any]], draws: int) -> list[str]:
    """What contradicts the claim: Student's t of the slopes over the draws, one-sided, at 99 %."""
    limit = float(student.ppf(0.99, draws - 1))
    chain, sharing = (
        rows[m]["slope_m_per_frame"] / rows[m]["slope_sd_m_per_frame"] for m in ("chain", "error_sharing")
    )
    out = ["chain does not grow along the line"] if chain <= limit else []
    return [*out, "error_sharing grows along the line"] if sharing > limit else out


def main() -> int:
    """Runs the bench; 0 if the paper's claim holds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder for surveys and results")
    parser.add_argument("--seed", type=int, default=1, help="of ground and flight, and of the first draw")
    parser.add_argument("--draws", type=int, default=12, help="draws of position and attitude")
    parser.add_argument("--quick", action="store_true", help="small surveys and 5 draws")
    asked = parser.parse_args()
    draws = 5 if asked.quick else asked.draws
    results = asked.out / "results"
    results.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {
        "command": f"python -m tools.bench.bench_paper --seed {asked.seed} --draws {draws}"
        + " --quick" * asked.quick,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "paper_ssim": PAPER_SSIM,
        "cases": {},
    }
    wrong, text = [], ""
    benches: dict[str, Bench] = {}
    for case in cases(asked.seed, asked.quick):
        started = time.monotonic()
        bench = benches[case.of].with_noise_of(case) if case.of else Bench(case, asked.out / case.name)
        benches[case.name] = bench
        for k in range(draws):
            bench.draw(asked.seed + k, compose=k == 0)
        rows = {name: outcome.row() for name, outcome in bench.outcomes.items()}
        report["cases"][case.name] = {"title": case.title, "plan": asdict(case.plan), "methods": rows}
        (results / f"paper_{case.name}.svg").write_text(plot(case.title, rows), encoding="utf-8")
        section = f"### {case.title}\n{table(rows)}"
        print(section, f"({time.monotonic() - started:.0f} s)\n", sep="", flush=True)
        text += section + "\n"
        if case.judged:
            wrong += [f"{case.title}: {fault}" for fault in faults(rows, draws)]
            crops = cv2.cvtColor(bench.crops(SHOWN), cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(results / f"paper_{case.name}.jpg"), crops, [cv2.IMWRITE_JPEG_QUALITY, 85])
    (results / "paper.json").write_text(json.dumps(_rounded(report), indent=1) + "\n", encoding="utf-8")
    (results / "paper.md").write_text(text, encoding="utf-8")
    print("\n".join(wrong) or "chain grows along the line, error_sharing does not")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
