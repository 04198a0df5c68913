"""Where the land of a mosaic on a matched surface lies, against what the verdict says of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.ownership import Ownership
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality import ground_doubt
from geomosaic.quality.ground_doubt import OFF_PX, places_of
from geomosaic.survey.model import Survey
from tools.bench.bench_surface_judge import errors_at, true_positions

_OPEN = 0


@dataclass(frozen=True)
class Land:
    """How far places of the mosaic lie off.

    places: how many. stated, true: share that the verdict expects to lie off by more than `OFF_PX` since the
    surface is wrong, and share that does. within_1_sd, within_2_sd: shares within 1 and 2 stated deviations.
    ground_stated_px, ground_true_px: displacement that 99 % keep below on open ground, stated
    (`ground unknown`, NaN if it isn't reported) and true.
    """

    places: int
    stated: float
    true: float
    within_1_sd: float
    within_2_sd: float
    ground_stated_px: float
    ground_true_px: float
    grade: str

    def figures(self) -> tuple[str, str, bool]:
        """What was found and is wanted, and whether it is: no more off than was said, and the word for it."""
        text = (
            f"off by more than {OFF_PX:g} px: stated {100.0 * self.stated:.1f} %, "
            f"true {100.0 * self.true:.1f} %; "
            f"within 1 and 2 deviations {100.0 * self.within_1_sd:.0f} and {100.0 * self.within_2_sd:.0f} %; "
            f"99 % of open ground: stated {self.ground_stated_px:.2f} px, true {self.ground_true_px:.2f} px; "
            f"called {self.grade}"
        )
        return text, "true <= stated", self.true <= self.stated


def judged_land(run: Path, truth: Path) -> Land:
    """The figures of a run on the dense surface. A place lies off by its height's error times the tangent of
    the angle at which its frame looks at it. What all frames miss in common is taken off; see
    `bench_surface_judge`."""
    summary = read_summary(run)
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    adjusted: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    ownership: Ownership = load_artefact(run, summary, "ownership", Ownership)
    ground: GroundSurface = load_artefact(run, summary, "ground", GroundSurface)
    at_m, tangent, _ = places_of(
        ground_doubt.Land(ownership, adjusted.poses, survey.work_frame, ground, adjusted.ground)
    )
    truth_record = json.loads((truth / "truth.json").read_text(encoding="utf-8"))
    errors, kind = errors_at(truth_record, survey, adjusted, true_positions(truth, survey), at_m)
    of_open = kind == _OPEN
    per_m = tangent / ownership.grid.gsd_m
    off_px = np.abs(errors - np.median(errors[of_open])) * per_m
    sd_px = ground.sd_at(at_m[:, 0], at_m[:, 1]) * per_m
    evidence = {e["name"]: e["value"] for e in summary["verdict"]["evidence"]}
    return Land(
        len(off_px),
        evidence["surface unsure"],
        float(np.mean(off_px > OFF_PX)),
        float(np.mean(off_px < sd_px)),
        float(np.mean(off_px < 2.0 * sd_px)),
        evidence.get("ground unknown", float("nan")),
        float(np.quantile(off_px[of_open], 0.99)),
        summary["verdict"]["grade"],
    )
