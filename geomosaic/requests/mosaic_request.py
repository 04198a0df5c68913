"""A mosaic of a folder of frames: each field is an option of `geomosaic mosaic` and of `geomosaic.mosaic`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from geomosaic.errors import FileError, InputError, UnknownNameError
from geomosaic.requests.mosaic_stages import OPTIONAL, ROOFS, STAGES, WITH_ROOFS
from geomosaic.requests.of_frames import crs_of
from geomosaic.requests.option import (
    ACCURACY,
    OUTPUT,
    RARE,
    SURFACE,
    Option,
    asked,
    length_given,
    required,
)
from geomosaic.requests.run_request import default_folder, recipe_of
from geomosaic.requests.survey_request import SurveyRequest

if TYPE_CHECKING:
    from geomosaic.pipeline.recipe import Recipe

SURFACES: Final = ("ties", "auto", "dense")


@dataclass(frozen=True, kw_only=True)
class MosaicRequest(SurveyRequest):
    """One map-true mosaic of a folder of aerial frames."""

    frames: Path = required(
        Option("folder of frames (JPEG, TIFF or PNG)", "FRAMES_DIR", sets="survey.read.frames")
    )
    ground_height: float | None = asked(
        Option(
            "ellipsoidal height of flat ground, in metres [measured in the frames]",
            "M",
            SURFACE,
            sets="projection.ground.height_m",
        )
    )
    surface: str = asked(
        Option(
            "ground onto which frames are projected: ties is a smooth surface through the tie points, dense "
            "is matched between frames; auto is ties, with the roofs that frames agree on in place",
            "|".join(SURFACES),
            SURFACE,
        ),
        "ties",
    )
    ortho: str | None = asked(
        Option(
            "with --surface dense, project onto the surface (roofs in place) or the terrain below it; auto "
            "takes the surface if frames agree clearly better on it [auto]",
            "auto|surface|terrain",
            SURFACE,
            sets="mosaic.ground.ortho",
        )
    )
    adjust: str | None = asked(
        Option(
            "adjustment method; 'geomosaic stages adjustment.solve' lists them",
            "METHOD",
            RARE,
            sets="adjustment.solve.method",
            methods=True,
        )
    )
    accuracy: float | None = asked(
        Option(
            "horizontal RMSE that you need, such as 5cm; a number alone is metres [what positions can give]",
            "LENGTH",
            ACCURACY,
            sets="quality.verdict.accuracy_m",
            parse=length_given,
        )
    )
    accuracy_vertical: float | None = asked(
        Option(
            "vertical RMSE that you need, such as 10cm; a number alone is metres",
            "LENGTH",
            ACCURACY,
            sets="quality.verdict.accuracy_vertical_m",
            parse=length_given,
        )
    )
    accuracy_relative: float | None = asked(
        Option(
            "RMSE of distances that you need, in per mille [what the positions can give]",
            "PERMILLE",
            ACCURACY,
            sets="quality.verdict.accuracy_relative_permille",
            least=0.0,
        )
    )
    reference: Path | None = asked(
        Option(
            "orthophoto or satellite image to compare the mosaic with",
            "TIF",
            ACCURACY,
            sets="quality.compare.reference",
        )
    )
    coregister: bool = asked(
        Option(
            "put the mosaic onto the --reference: its places found in the frames are control points in plan",
            None,
            ACCURACY,
        ),
        False,
    )
    surface_reference: Path | None = asked(
        Option(
            "elevation model or point cloud to compare the dense surface with",
            "FILE",
            ACCURACY,
            sets="quality.surface.reference",
        )
    )
    crs: str = asked(
        Option("map CRS of the mosaic; auto is the UTM zone", "auto|EPSG:n", OUTPUT, sets="survey.read.crs"),
        "auto",
    )
    gsd: str = asked(
        Option(
            "pixel size of the mosaic in metres; auto is that of the frames",
            "auto|M",
            OUTPUT,
            sets="mosaic.seams.gsd_m",
        ),
        "auto",
    )
    edges: str | None = asked(
        Option(
            "trim leaves out ground seen obliquely or coarsely, or of extrapolated height; keep keeps it "
            "[trim]",
            "trim|keep",
            OUTPUT,
            sets="mosaic.seams.edges",
        )
    )
    brighten: bool = asked(
        Option(
            "one curve for the whole mosaic that brings its middle brightness to mid-grey, for dark or pale "
            "frames of 8 bits",
            None,
            OUTPUT,
            sets="mosaic.tones.brighten",
        ),
        False,
    )
    pdf: bool = asked(
        Option(
            "also print the report to report.pdf (needs Chromium)", None, OUTPUT, sets="export.report.pdf"
        ),
        False,
    )

    def stages(self) -> list[str]:
        """The stages that are asked for. Raises: `InputError` where options contradict each other."""
        dense = self.surface == "dense"
        if self.surface not in SURFACES:
            raise UnknownNameError("value of --surface", self.surface, SURFACES)
        if self.surface_reference is not None and not dense:
            raise InputError(
                "there is no surface to compare it with",
                file=self.surface_reference,
                fix="add --surface dense",
            )
        if self.dem_offset is not None and self.dem is None:
            raise InputError("--dem-offset has an effect only on a DEM", fix="add --dem FILE")
        if self.panel and self.radiometry != "reflectance":
            raise InputError("--panel has an effect only on reflectance", fix="add --radiometry reflectance")
        if self.coregister and self.reference is None:
            raise InputError("--coregister needs a map to put the mosaic onto", fix="add --reference TIF")
        if self.coregister and self.reference is not None and not self.reference.is_file():
            raise FileError("there is no such file", file=self.reference, fix="give one with --reference TIF")
        if self.ortho is not None and not dense:
            raise InputError("--ortho has an effect only on a dense surface", fix="add --surface dense")
        wanted = dict.fromkeys(OPTIONAL, dense) | {
            "matching.flying_height": self.ground_height is None,
            "matching.reference": self.coregister,
            "quality.compare": self.reference is not None,
            "quality.surface": self.surface_reference is not None,
        }
        if self.surface == "auto":
            return [id for id in WITH_ROOFS if id in ROOFS or wanted.get(id, True)]
        return [id for id in STAGES if wanted.get(id, True)]

    def recipe(self) -> Recipe:
        """The checked recipe. Raises: `InputError` for what cannot be used."""
        if self.pdf:
            from geomosaic.report.pdf import browser

            browser()
        stages, given = self.stages(), self.parameters()
        self.prepare(stages)
        if self.coregister:
            given["matching.reference"] = {"reference": self.reference}
        if self.height_datum is not None:
            given.setdefault("export.surface", {})["heights"] = self.height_datum
        if self.align_to is not None:
            given["survey.read"]["crs"] = crs_of(self.align_to, self.crs)
        named = "mosaic", f"frames of {self.frames.name}"
        recipe = recipe_of(named, stages, given, self.seed, self.set)
        _check_used(recipe.steps[0].params.model_dump())
        return recipe

    def folder(self, recipe: Recipe) -> Path:
        """Where the run goes: what is asked for, or a folder next to the frames."""
        return self.output or default_folder(self.frames, "mosaic")


def _check_used(read: Mapping[str, Any]) -> None:
    """Raises: `InputError` for the CRS of a file that is neither given nor in the folder of frames. read: the
    parameters of survey.read."""
    from geomosaic.survey.folder import project_files

    given = read["pos"] is not None or read["gcp"] is not None
    if read["pos_crs"] is not None and not given and not project_files(read["frames"]):
        problem = "--pos-crs has an effect only on a POS or a control file"
        raise InputError(problem, fix="add --pos FILE or --gcp FILE")
