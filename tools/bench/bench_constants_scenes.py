"""Small scenes of both kinds of survey, plain ones and ones with faults, run once, stage by stage."""

from __future__ import annotations

import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType
from typing import Any

import geomosaic
from geomosaic.errors import GeomosaicError
from geomosaic.pipeline.context import Notes
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.recipe import Recipe, RecipeStep
from geomosaic.pipeline.run_folder import RunFolder
from geomosaic.pipeline.single_stage import StageInputs, run_stage
from geomosaic.requests.mosaic_request import MosaicRequest
from geomosaic.requests.recipe_request import RecipeRequest
from geomosaic.requests.strips_request import StripsRequest

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
FEW = "matching.sift.keypoints=700"
SMALL = ["--width-px", "480", "--height-px", "360", "--height-above-ground-m", "54"]
STRIPS = ["--ccds", "3", "--lines", "2400", "--width-px", "128", "--overlap-px", "56", "--relief-m", "200"]


@dataclass(frozen=True)
class Scene:
    """What is simulated, and what is asked of it: `mosaic`, `strips`, or a recipe's name; options by the
    names of the request's fields, files below the survey's folder. flight: a folder of real frames, of which
    nothing is simulated."""

    name: str
    simulated: str
    asked: str
    options: Mapping[str, Any]
    flight: str = ""


SCENES = (
    Scene("flat", "--lines 2 --frames-per-line 6 --pos-in exif --seed 1", "mosaic", {}),
    Scene("wrong tags", "--lines 3 --frames-per-line 6 --pos-in exif --yaw-wrong-share 0.2 --turned 9-11 "
          "--gps-outliers 1 --no-gps 4 --seed 2", "mosaic", {}),
    Scene("control", "--lines 2 --frames-per-line 6 --control-points 9 --relief-m 12 "
          "--relief-wavelength-m 80 --rolling-shutter-s 0.04 --no-lens-reported --height-bias-m 8 "
          "--seed 3", "mosaic",
          {"pos": "pos.csv", "gcp": "gcp_list.txt", "dem": "truth/dem.tif"}),
    Scene("dense", "--lines 2 --frames-per-line 4 --buildings-stand --trees-stand --exposure-sd 0.1 "
          "--vignetting 0.2 --seed 4", "mosaic",
          {"surface": "dense", "surface_reference": "truth/dsm.tif", "reference": "truth/ortho.tif"}),
    Scene("dirty 1", "--dirty 1", "mosaic", {}),
    Scene("dirty 3", "--dirty 3", "mosaic", {}),
    Scene("dirty 5", "--dirty 5", "mosaic", {}),
    Scene("paper", "--lines 2 --frames-per-line 5 --seed 6", "paper",
          {"set": ["survey.read.pos=FOLDER/pos.csv"]}),
    Scene("quick", "--lines 2 --frames-per-line 5 --pos-in exif --smooth-forest-share 0.3 --seed 7",
          "quick-look", {}),
    Scene("strips", "--seed 1", "strips", {}),
    Scene("strips with faults", "--ccds 4 --cloud-cover 0.3 --low-contrast-share 0.3 --saturated-share 0.1 "
          "--dead 4 --jitter-5hz-px 1.5 --seed 2", "strips", {}),
    Scene("strips in object space", "--attitude-noise-urad 2 --dem-error-m 5 --seed 3",
          "strips-virtual-line", {}),
    Scene("strips by segments", "--low-contrast-share 0.3 --seed 4", "strips-piecewise-linear", {}),
    Scene("strips, whole", "--cloud-cover 0.2 --seed 5", "strips-whole-scene", {}),
    Scene("strips by images", "--seed 6", "strips-image-registration", {}),
)  # fmt: skip


@dataclass(frozen=True)
class StageOutcome:
    """A stage's outputs by name and its notes, or the words with which it failed. seconds: of processor."""

    outputs: Mapping[str, Any]
    notes: Notes
    seconds: float
    failure: str = ""


@dataclass
class Done:
    """A stage of a scene, done once as it is. inputs: artefacts by name. summary: of the stages before.
    codes: (file, name, first line) of all functions that it called. folder: of the scene's run."""

    scene: str
    step: RecipeStep
    inputs: Mapping[str, Any]
    summary: Mapping[str, Any]
    outcome: StageOutcome
    codes: frozenset[tuple[str, str, int]]
    folder: Path

    def again(self, work: Path) -> StageOutcome:
        """The stage once more, as it is now."""
        given = StageInputs(RunFolder(self.folder, overwrite=True), self.inputs, self.summary)
        begun = time.process_time()
        try:
            values, notes = run_stage(Recipe("", "", 0, (self.step,)), given, work_folder=work)
        except GeomosaicError as error:
            return StageOutcome({}, Notes(), time.process_time() - begun, f"{type(error).__name__}: {error}")
        return StageOutcome(values, notes, time.process_time() - begun)


def stages(scene: Scene, out: Path) -> list[Done]:
    """All stages of a scene; kept in its folder as long as no line of the package changes."""
    folder, mark = out / scene.name.replace(" ", "_").replace(",", ""), _mark(scene)
    kept = folder / "stages.pickle"
    if kept.exists():
        was, done = pickle.loads(kept.read_bytes())
        if was == mark:
            return list(done)
    _simulate(scene, folder)
    done = _run(scene, folder)
    kept.write_bytes(pickle.dumps((mark, done)))
    return done


def _mark(scene: Scene) -> str:
    hashes, package = FileHashes(), Path(geomosaic.__file__).parent
    return repr(scene) + "".join(hashes.of_file(path) for path in sorted(package.rglob("*.py")))


def _simulate(scene: Scene, folder: Path) -> None:
    if scene.flight or (folder / "simulated").exists():
        return
    kind, usual = ("strips", STRIPS) if scene.asked.startswith("strips") else ("frames", SMALL)
    given = scene.simulated.split()
    usual = [w for k in range(0, len(usual), 2) if usual[k] not in given for w in usual[k : k + 2]]
    words = [str(GEOMOSAIC), "simulate", kind, str(folder), *usual, *given]
    subprocess.run([*words, "--workers", "1", "--overwrite", "-q"], check=True)
    (folder / "simulated").touch()


def recipe_of(scene: Scene, folder: Path) -> Recipe:
    """The scene's recipe."""
    options = {
        name: folder / value if isinstance(value, str) and (folder / value).exists() else value
        for name, value in scene.options.items()
    }
    if scene.flight:
        return MosaicRequest(frames=Path(scene.flight), **options).recipe()
    if scene.asked == "mosaic":
        return MosaicRequest(frames=folder / "frames", set=[FEW], **options).recipe()
    if scene.asked == "strips":
        return StripsRequest(geometry=folder / "geometry.yaml", **options).recipe()
    given = folder / ("geometry.yaml" if scene.asked.startswith("strips") else "frames")
    options["set"] = [word.replace("FOLDER", str(folder)) for word in options.get("set", [])]
    options["set"] += [FEW] if given.name == "frames" and scene.asked != "quick-look" else []
    return RecipeRequest(name=scene.asked, input=given, **options).recipe()


def _run(scene: Scene, folder: Path) -> list[Done]:
    """Every stage once, its functions noted."""
    recipe, run = recipe_of(scene, folder), folder / "run"
    RunFolder.opened(run, overwrite=True)
    artefacts: dict[str, Any] = {}
    summary: dict[str, Any] = {"recipe": recipe.plain(), "inputs": {}, "warnings": [], "metrics": {}}
    summary |= {"versions": {}, "timings_s": {}, "artefacts": {}, "memory_mb": {}}
    done = []
    for step in _without_exports(recipe.steps):
        names = (*step.stage.inputs, *step.stage.optional_inputs)
        inputs = {name: artefacts[name] for name in names if name in artefacts}
        before = pickle.loads(pickle.dumps(summary))
        one = Done(scene.name, step, inputs, before, StageOutcome({}, Notes(), 0.0), frozenset(), run)
        with _called() as codes:
            one.outcome = one.again(run / "work" / step.stage.id)
        one.codes = frozenset((c.co_filename, c.co_name, c.co_firstlineno) for c in codes)
        if one.outcome.failure:
            raise SystemExit(f"{scene.name}, {step.stage.id}: {one.outcome.failure}")
        artefacts |= one.outcome.outputs
        one.outcome.notes.add_to(summary)
        done.append(one)
    return done


def _without_exports(steps: Sequence[RecipeStep]) -> list[RecipeStep]:
    """The steps that estimate or compose, and exports that they take something from."""
    kept: list[RecipeStep] = []
    taken: set[str] = set()
    for step in reversed(steps):
        if not step.stage.id.startswith("export.") or taken & step.stage.outputs.keys():
            kept.insert(0, step)
            taken |= {*step.stage.inputs, *step.stage.optional_inputs}
    return kept


@contextmanager
def _called() -> Iterator[set[CodeType]]:
    """The functions that are called while it lasts."""
    codes: set[CodeType] = set()

    def note(frame: Any, event: str, _: object) -> None:
        if event == "call":
            codes.add(frame.f_code)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        yield codes
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
