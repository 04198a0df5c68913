"""Commands that run one stage by itself: `simulate`, `export`, `evaluate`."""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geomosaic.cli.help import HeadedCommand, with_help_all
from geomosaic.cli.options import AsJson, Overwrite, Quiet, Sets, Workers, with_options
from geomosaic.errors import FileError, InputError
from geomosaic.requests.option import RUNNING
from geomosaic.requests.run_request import cores

if TYPE_CHECKING:
    from geomosaic.pipeline.context import Notes
    from geomosaic.pipeline.recipe import Recipe
    from geomosaic.pipeline.single_stage import StageInputs
    from geomosaic.pipeline.stage import Stage

_Seed = Annotated[
    int | None,
    typer.Option(help="seed of all random numbers [0]", metavar="N", min=0, rich_help_panel=RUNNING),
]


def add_stage_commands(app: typer.Typer, group: str, only: str | None) -> None:
    """One command for each stage `group.*`, or for that of the name `only`; broken ones raise when run."""
    from geomosaic.cli.declared import command_of
    from geomosaic.cli.export import add_folder, described, suiting
    from geomosaic.cli.simulation_help import simulation_headings
    from geomosaic.pipeline.registry import installed

    if group == "simulate":
        import geomosaic_simulate  # noqa: F401  (a package of its own: main says how to install it)
    ids = [id for id in installed().ids() if id.startswith(f"{group}.")]
    if f"{group}.{only}" in ids:
        ids = [f"{group}.{only}"]
    working = {stage.id: stage for stage in installed().all()[0]} if len(ids) > 1 else {}
    chosen = [working.get(id) or (installed().get(id) if len(ids) == 1 else None) for id in ids]
    stages = [stage for stage in chosen if stage is not None]
    if group == "export" and only is not None and len(ids) > 1 and Path(only).is_dir():
        stages = suiting(stages, Path(only))
        add_folder(app, only)
    for stage in stages:
        if group == "simulate":
            place, more = ("out", "folder to write"), {"seed": (_Seed, None), "overwrite": (Overwrite, False)}
        else:
            place, more = ("run", "folder of a finished run"), {}
        more |= {"workers": (Workers, None), "quiet": (Quiet, False)}
        headings = simulation_headings(stage)
        command = command_of(stage, place, _runner(stage), more, headings)
        short = described(stage) if len(ids) > 1 else None
        command = with_help_all(command) if headings else command
        app.command(stage.id.partition(".")[2], cls=HeadedCommand, short_help=short)(command)


def _runner(stage: type[Stage]) -> Any:
    def run(
        folder: Path,
        *,
        seed: int | None = None,
        workers: int | None = None,
        overwrite: bool = False,
        quiet: bool = False,
        **options: Any,
    ) -> None:
        from geomosaic.cli.declared import recipe_of_options
        from geomosaic.pipeline.run_folder import RunFolder
        from geomosaic.pipeline.single_stage import StageInputs
        from geomosaic.pipeline.stage import RunFile
        from geomosaic.requests.naming import named_as_options

        before = _files(folder)
        summary, inputs = _inputs(stage, folder)
        with named_as_options(stage.id):
            recipe = recipe_of_options(stage, options, seed or 0)
            place = RunFolder(folder) if stage.inputs else RunFolder.opened(folder, overwrite=overwrite)
            values, _ = _run(recipe, StageInputs(place, inputs, summary), workers, quiet)
        if quiet:
            return
        names = {*stage.results, *(value.name for value in values.values() if isinstance(value, RunFile))}
        made = {folder / name for name in names if (folder / name).exists()}
        for path in sorted(made or _files(folder) - before) or [folder]:
            print(path)

    return run


def _files(folder: Path) -> set[Path]:
    return {p for p in folder.iterdir() if not p.name.startswith(".")} if folder.is_dir() else set()


def _inputs(stage: type[Stage], folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The summary of a finished run and the artefacts a stage takes from it."""
    if not stage.inputs:
        return {}, {}
    from geomosaic.pipeline.run_results import load_artefact, read_summary

    summary = read_summary(folder)
    inputs = {name: load_artefact(folder, summary, name, kind) for name, kind in stage.inputs.items()}
    for name, kind in stage.optional_inputs.items():
        if name in summary["artefacts"]:
            inputs[name] = load_artefact(folder, summary, name, kind)
    return summary, inputs


def _run(
    recipe: Recipe, given: StageInputs, workers: int | None = None, quiet: bool = False
) -> tuple[dict[str, Any], Notes]:
    from geomosaic.cli.progress import progress
    from geomosaic.pipeline.single_stage import run_stage

    count = workers or cores()
    with tempfile.TemporaryDirectory(prefix="geomosaic-") as work, progress(quiet=quiet) as reporter:
        return run_stage(recipe, given, work_folder=Path(work), workers=count, reporter=reporter)


@dataclass(frozen=True)
class EvaluateOptions:
    """What `geomosaic evaluate` is asked for."""

    targets: Annotated[
        list[Path],
        typer.Argument(
            help="a run folder or a mosaic; with --scores, files of scores", metavar="RUN|TIF|FILES"
        ),
    ]
    reference: Annotated[
        Path | None,
        typer.Option(help="orthophoto or satellite image to compare the mosaic with", metavar="TIF"),
    ] = None
    surface_reference: Annotated[
        Path | None,
        typer.Option(
            help="elevation model (raster) or point cloud (LAS, LAZ) to compare the surface with",
            metavar="FILE",
        ),
    ] = None
    scores: Annotated[
        bool, typer.Option("--scores", help="gather the scores that viewers saved from reports")
    ] = False
    set: Sets = None
    as_json: AsJson = False


@with_options(EvaluateOptions)
def evaluate(asked: EvaluateOptions) -> None:
    """Compare a mosaic or a surface with a reference.

    A mosaic is compared by displacement, jumps and SSIM, a run's surface by heights. With --scores, gather
    viewers' scores instead.
    """
    if [asked.scores, asked.reference is not None, asked.surface_reference is not None].count(True) != 1:
        raise InputError(
            "what the run is to be compared with is missing or given twice",
            fix="give one of --reference TIF, --surface-reference FILE and --scores",
        )
    from geomosaic.requests.naming import named_as_options

    if asked.scores:
        _scores(asked.targets, asked.as_json)
    elif len(asked.targets) > 1:
        raise InputError("only one run is compared at a time", fix="give one run folder or one mosaic")
    elif asked.surface_reference is not None:
        with named_as_options("quality.surface", {"reference": "--surface-reference"}):
            _compare_surface(asked.targets[0], asked.surface_reference, asked.set, asked.as_json)
    else:
        with named_as_options("quality.compare", {"reference": "--reference"}):
            _compare(asked.targets[0], asked.reference, asked.set, asked.as_json)


def _scores(files: list[Path], as_json: bool) -> None:
    """A table of runs with their viewers' mean opinions."""
    from geomosaic.quality.scores import CRITERIA, gathered, read_opinion

    runs = gathered([read_opinion(file) for file in files])
    if as_json:
        print(json.dumps([asdict(run) for run in runs], indent=2))
        return
    width = max(len("run"), *(len(run.run) for run in runs))
    print(f"{'run':<{width}}", "viewers", *(f"{c.key:>8}" for c in CRITERIA))
    for run in runs:
        print(f"{run.run:<{width}}", f"{run.viewers:>7}", *(f"{run.mean[c.key]:>8.2f}" for c in CRITERIA))


def _compare(target: Path, reference: Path | None, set: Sets, as_json: bool) -> None:
    from geomosaic.pipeline.context import Context
    from geomosaic.pipeline.run_folder import RunFolder
    from geomosaic.pipeline.single_stage import StageInputs

    recipe = _referring("quality.compare", reference, set)
    path = target / "mosaic.tif" if target.is_dir() else target
    if not path.is_file():
        raise FileError("no such file", file=path, fix="give a finished run's folder or a GeoTIFF")
    with tempfile.TemporaryDirectory(prefix="geomosaic-") as work:
        file = Context(path.absolute().parent, work_folder=Path(work)).run_file(path.name)
    stage = recipe.steps[0].stage
    summary, inputs = _inputs(stage, target) if (target / "run.json").is_file() else ({}, {})
    given = StageInputs(RunFolder(path.parent), {**inputs, "mosaic_file": file}, summary)
    _, notes = _run(recipe, given)
    if as_json:
        _print_json({"mosaic": path, "reference": reference}, notes)
        return
    for name, value in _leaves(notes.metrics):
        print(f"{name:<40} {value:.6g}" if isinstance(value, float) else f"{name:<40} {value}")


def _compare_surface(run: Path, reference: Path, set: Sets, as_json: bool) -> None:
    """A table by slope, class and support, and the files that show where the differences are."""
    from geomosaic.pipeline.run_folder import RunFolder
    from geomosaic.pipeline.run_results import read_summary
    from geomosaic.pipeline.single_stage import StageInputs

    recipe = _referring("quality.surface", reference, set)
    stage = recipe.steps[0].stage
    if "surface_file" not in read_summary(run)["artefacts"]:
        raise FileError("this run has no surface to compare", file=run, fix="run it with --surface dense")
    summary, inputs = _inputs(stage, run)
    values, notes = _run(recipe, StageInputs(RunFolder(run), inputs, summary))
    if as_json:
        _print_json({"run": run, "reference": reference}, notes)
        return
    found = values["surface_comparison"]
    rows = [("all", found.over_all), ("after the best shift and tilt", found.after_fit)]
    rows += [(f"slope {name}", figures) for name, figures in found.by_slope]
    rows += [*found.by_kind, *found.by_support]
    width = max(len(name) for name, _ in rows)
    names = ("points", "median m", "NMAD m", "RMSE m", "68 % m", "95 % m")
    print(f"{'surface - reference':<{width}}", *(f"{name:>10}" for name in names))
    for name, f in rows:
        figures = (f.median_m, f.nmad_m, f.rmse_m, f.abs_68_m, f.abs_95_m)
        print(f"{name:<{width}} {f.n:>10,}", *(f"{value:>10.3f}" for value in figures))
    print(f"datum: {found.datum}")
    for name in stage.results:
        print(run / name)


def _referring(id: str, reference: Path | None, set: Sets) -> Recipe:
    """A stage that takes a reference."""
    from geomosaic.pipeline.recipe import unwired_recipe
    from geomosaic.pipeline.registry import installed

    plain = {"stages": [{"stage": id, "params": {"reference": reference}}]}
    return unwired_recipe(plain, installed(), set or ())


def _print_json(of: dict[str, Path | None], notes: Notes) -> None:
    named = {name: str(path) for name, path in of.items()}
    print(json.dumps({**named, **notes.metrics, "warnings": notes.warnings}, indent=2))


def _leaves(metrics: dict[str, Any], above: str = "") -> list[tuple[str, Any]]:
    out = []
    for name, value in metrics.items():
        at = f"{above}.{name}" if above else name
        out += _leaves(value, at) if isinstance(value, dict) else [(at, value)]
    return out
