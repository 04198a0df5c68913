"""What the documents show is so: every command parses and nearly all run, errors and codes exist."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

import geomosaic as gm
from geomosaic.cli.app import build_app
from geomosaic.cli.main import main
from geomosaic.errors import InputError

try:  # typer has a click of its own now
    from typer._click.exceptions import MissingParameter, NoArgsIsHelpError, UsageError
except ImportError:
    from click.exceptions import MissingParameter, NoArgsIsHelpError, UsageError

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "methods").glob("*.md"), *ROOT.glob("*.md"),
     *(ROOT / "examples").glob("*/*.md")]
)  # fmt: skip
GUIDES = ("index", "start", "howto", "python")
SMALL = "--lines 1 --frames-per-line 3 --width-px 240 --height-px 180"
"""A flight of three small frames does where people simulate a usual one."""


SMALL_STRIPS = "--ccds 2 --width-px 256 --lines 1500 --row-separation-lines 300"
HISTORY = ("CHANGELOG.md", "plan.md", "results.md")
"""They say what was done, with data that aren't here; what they show is parsed."""
NOT_RUN = {
    "geomosaic fetch": "asks a server: test_fetch.py has one",
    "geomosaic push": "writes to a server: test_push.py has one",
    "geomosaic geoid": "asks a server: test_heights.py has one",
    "geomosaic control": "serves a page until it is stopped: test_marking_chromium.py opens it",
    "FRAMES-control": "what that page writes: test_marking_chromium.py mosaics with it",
    "geomosaic compare": "wants two runs of the same ground: test_changes.py makes some",
    "geomosaic frames": "wants a video: test_video_frames.py makes some",
    "geomosaic open": "serves a page until it is stopped: test_viewer_chromium.py opens it",
    "geomosaic watch": "waits for frames: test_watch.py copies some",
    "geomosaic measure": "wants lines and polygons: test_measure.py has some",
    "geomosaic view": "opens a window: test_recording_readers.py",
    "--camera-kind": "wants two cameras' pictures: test_camera_kinds.py has some",
    "--formula temperature": "wants a thermal band: test_index.py has one",
    "NDVI": "wants a near-infrared band: test_index.py has one",
    "--radiometry": "wants a multispectral rig's frames: test_reflectance.py has some",
    "--dask": "wants a cluster: test_dask.py has one",
    "--incremental": "wants a finished run by the same options: test_incremental.py has one",
    "surface": "matches a surface: test_export_surface.py",
    "--scores": "wants what people saved in their browsers: test_scores.py",
    "--dirty": "dozens of frames: test_dirty.py",
    "qgis-script": "writes into QGIS' own folder: test_qgis_script.py",
    "haze": "wants the example installed: test_example_package.py",
}
"""What stands in a command that is parsed and not run, and why."""
STANDS_FOR = {
    **dict.fromkeys(("FRAMES_DIR", "FRAMES", "FOLDER", "CARD"), "flight/frames"),
    **dict.fromkeys(("RUN.mcap", "A.mcap", "B.mcap"), "flight/frames-mosaic/run.mcap"),
    **dict.fromkeys(("RUN2", "NEW"), "again"),
    **dict.fromkeys(("GEOMETRY.yaml", "OUT/geometry.yaml"), "scene/geometry.yaml"),
    "FRAMES/pos.csv": "flight/pos.csv", "ID": "matching.sift", "NAME": "stac",
}  # fmt: skip


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


def shown(page: Path) -> Iterator[tuple[str, bool]]:
    """Commands of a page, and whether they stand by themselves, not in a sentence."""
    text = page.read_text(encoding="utf-8")
    command = r"^%s(?:\.venv/bin/)?(geomosaic [a-z].*)$"
    fenced = "\n".join(re.findall(r"^```.*?^```", text, re.M | re.S))
    for line in re.findall(command % "", fenced, re.M) + re.findall(command % " {4}", text, re.M):
        yield line, True
    for line in re.findall(r"`(geomosaic [a-z][^`\n]*)`", text):
        yield line, False


def words(line: str) -> list[str]:
    """A command's words, without its comment and what is left to choose."""
    line = re.split(r" {2,}|\s#", line)[0]
    return shlex.split(re.sub(r"\[[^]]*\]|\.\.\.", "", line))[1:]


def parse(argv: list[str]) -> None:
    """As the command line does it, but for doing it. Raises: `UsageError`, `InputError`."""
    command: Any = typer.main.get_command(build_app(argv))
    context, rest, name = None, argv, "geomosaic"
    while True:
        context = command.make_context(name, rest, parent=context)
        if not hasattr(command, "resolve_command"):
            return
        asked, found, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        assert asked is not None and found is not None
        command, name = found, asked


def test_what_is_no_command_does_not_parse() -> None:
    for line in ("reads files", "mosaic", "mosaic frames --no-such-option", "export no-such-form RUN"):
        with pytest.raises((UsageError, InputError)):
            parse(line.split())


@pytest.mark.parametrize("page", [p for p in PAGES if "geomosaic " in p.read_text()], ids=lambda p: p.name)
def test_every_command_is_one(page: Path) -> None:
    for line, alone in shown(page):
        if "(" in line or re.search(r"\b(frames|run)\|", line) or words(line) == ["export", "RUN"]:
            continue
        with contextlib.redirect_stdout(io.StringIO()):
            try:
                parse([STANDS_FOR.get(word, word) for word in words(line)])
            except (MissingParameter, NoArgsIsHelpError):
                assert not alone, line
            except typer.Exit:
                pass
            except UsageError as error:
                raise AssertionError(f"{line}: {error.format_message()}") from error


def test_what_commands_name_is_there() -> None:
    """Targets of make, the tools, recipes by name, and parameters of stages that --set and tables name."""
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    known = {f"{id}.{p['name']}" for id, stage in gm.list_stages().items() for p in stage["params"]}
    recipes = {path.stem.replace("_", "-") for path in (ROOT / "geomosaic" / "recipes").glob("*.yaml")}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"(?:^ *|`)make ((?!-)[a-z][a-z-]*)(?=[`\s])", text, re.M):
            assert target in targets, f"{page.name}: make {target}"
        for tool in re.findall(r"\b(tools/[\w/]+\.(?:py|sh))\b", text):
            assert (ROOT / tool).is_file(), f"{page.name}: {tool}"
        for tool in re.findall(r"-m (tools(?:\.\w+)+)", text):
            path = ROOT / tool.replace(".", "/")
            assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), (
                f"{page.name}: {tool}"
            )
        for name in re.findall(r"--set ([a-z_]+\.[a-z_0-9]+\.[a-z_0-9]+)=", text):
            example = ROOT / "examples" in page.parents  # stages of its own, which its own tests know
            assert name in known or example, f"{page.name}: --set {name}"
        for name in re.findall(r"geomosaic run ([a-z][a-z-]*)(?=[ `\n])", text):
            assert name in recipes, f"{page.name}: geomosaic run {name}"


def test_the_results_page_is_generated(tmp_path: Path) -> None:
    """After new measurements run `make results`."""
    written = tmp_path / "results.md"
    tool = ROOT / "tools" / "docs" / "results_page.py"
    subprocess.run([sys.executable, tool, "--out", written], cwd=ROOT, check=True)
    page = written.read_text(encoding="utf-8")
    assert page == (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert all((ROOT / "docs" / linked).is_file() for linked in re.findall(r"\]\(([^)]+)\)", page))


def test_the_results_page_needs_no_particular_row(tmp_path: Path) -> None:
    """One file alone, of one flight that ended without a mosaic, gives a page."""
    flights = json.loads((ROOT / "docs" / "results" / "flights.json").read_text(encoding="utf-8"))
    name, flight = next(iter(flights["flights"].items()))
    flights["flights"] = {name: flight | {"exit_code": 2}}
    (tmp_path / "flights.json").write_text(json.dumps(flights), encoding="utf-8")
    command = [
        sys.executable,
        "tools/docs/results_page.py",
        "--results",
        tmp_path,
        "--out",
        tmp_path / "page.md",
    ]
    subprocess.run(command, cwd=ROOT, check=True)
    assert "**0 of 1**" in (tmp_path / "page.md").read_text(encoding="utf-8")


def test_the_architecture_knows_every_room() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## The rooms")[2]
    named = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\|[^|]*\|", text.partition("## ")[0], re.M))))
    rooms = {path.parent.name for path in (ROOT / "geomosaic").glob("*/__init__.py")}
    assert rooms <= named
    assert all((ROOT / "geomosaic" / name).exists() or (ROOT / "geomosaic" / f"{name}.py").is_file()
               for name in named - {"geomosaic_simulate"})  # fmt: skip


def test_files_that_pages_name_are_there() -> None:
    """Modules, tests and folders of the code, by their whole path or below the room that a page is about."""
    rooms = [ROOT, ROOT / "geomosaic", ROOT / "geomosaic" / "adjustment"]
    for page in (ROOT / "docs" / "architecture.md", *(ROOT / "docs" / "methods").glob("*.md")):
        for name in re.findall(r"`((?:[a-z_]+/)+(?:[a-z_]+\.py)?)`", page.read_text(encoding="utf-8")):
            assert any((room / name).exists() for room in rooms), f"{page.name}: {name}"


def test_the_notebook_is_of_today() -> None:
    """Its commands parse, its cells compile, and what it reads of a run are a run's attributes."""
    notebook = json.loads((ROOT / "examples" / "notebook" / "mosaic.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    asked = [cell.removeprefix("!") for cell in cells if cell.startswith("!")]
    assert asked
    for line in asked:
        parse(words(line))
    code = "\n".join(cell for cell in cells if not cell.startswith("!"))
    compile(code, "mosaic.ipynb", "exec")
    assert all(hasattr(gm.Run, name) for name in re.findall(r"\brun\.(\w+)", code))


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the guides' commands are run in, one after the other."""
    return tmp_path_factory.mktemp("guides")


@pytest.mark.proof
def test_the_guides_run(
    desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(desk)
    for name in ("start", "index", "howto"):
        for line in "".join(blocks(ROOT / "docs" / f"{name}.md", "sh")).splitlines():
            argv = shlex.split(line)[1:]
            if argv[0] == "simulate":
                argv += SMALL.split()
            if argv[0] in ("mosaic", "run", "replay"):
                argv += ["--workers", "1"]
            if "-o" in argv and argv[0] == "mosaic" and "--gcp" not in argv:  # others run the bundle
                argv += ["--adjust", "least_squares"]
            if argv[0] == "evaluate":
                argv += ["--set", "quality.compare.patch_px=48", "--set", "quality.compare.search_px=32"]
            code = main(argv)
            output = capsys.readouterr()
            assert code == 0 or (argv[0], code) == ("diff", 1), f"{line}\n{output.out}{output.err}"
    assert (desk / "flight" / "frames-mosaic" / "mosaic.tif").is_file()
    for block in blocks(ROOT / "docs" / "python.md", "python"):
        exec(block.replace(", set={", ", workers=1, set={"), globals())


@pytest.fixture
def surveyed(desk: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The guides' folder with what their first page makes, and a scene of strips."""
    monkeypatch.chdir(desk)
    if not Path("flight/frames-mosaic/run.json").exists():
        assert main(["simulate", "frames", "flight", *SMALL.split()]) == 0
        assert main(["mosaic", "flight/frames", "--workers", "1", "-q"]) == 0
    if not Path("scene/run/run.json").exists():
        assert main(["simulate", "strips", "scene", *SMALL_STRIPS.split()]) == 0
        assert main(["strips", "scene/geometry.yaml", "-o", "scene/run", "-q"]) == 0
    return desk


def of_the_pages() -> list[list[str]]:
    """Each whole command once that pages other than the guides show, save what isn't run."""
    found: dict[tuple[str, ...], None] = {}
    for page in PAGES:
        for line, alone in () if page.name in HISTORY else shown(page):
            ran = alone and f"\n{line}\n" in "\n".join(blocks(page, "sh"))
            if ran or "(" in line or any(part in line for part in NOT_RUN):
                continue
            with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(typer.Exit):
                try:
                    parse([STANDS_FOR.get(word, word) for word in words(line)])
                except (UsageError, InputError):  # a command's name alone, or a sentence
                    continue
            found[tuple(words(line))] = None
    return [list(argv) for argv in found]


@pytest.mark.proof
def test_the_commands_of_the_other_pages_run(surveyed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = (ROOT / "recipes" / "quick_look.yaml").read_text(encoding="utf-8")
    read = "  - {stage: survey.read, params: {frames: flight/frames}}"
    Path("recipe.yaml").write_text(quick.replace("  - survey.read", read), encoding="utf-8")
    commands: dict[tuple[str, ...], None] = {}
    for number, (name, *more) in enumerate(of_the_pages()):
        run = "scene/run" if name in ("strips", "misplacement") else "flight/frames-mosaic"
        more = [{**STANDS_FOR, "RUN": run}.get(word, word) for word in more]
        if name == "simulate" and not {"--help", "--help-all"} & {*more}:
            small = SMALL if more[0] == "frames" else SMALL_STRIPS
            more = [more[0], f"out{number}", *more[2:], *small.split()]
        if name in ("mosaic", "run", "replay"):
            more += ["--workers", "1"]
        if name == "mosaic" and "--adjust" not in more:  # the guides run the bundle
            more += ["--adjust", "least_squares"]
        commands[name, *more] = None
    assert {c[0] for c in commands} >= {"mosaic", "strips", "run", "replay", "inspect", "export", "simulate"}
    for argv in commands:
        code = main([*argv])
        output = capsys.readouterr()
        assert code == 0, f"{argv}\n{output.out}{output.err}"


@pytest.mark.proof
def test_every_export_of_the_table_runs_and_none_is_missing(
    surveyed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a run whose cache is gone, twice where it is cheap: the same paths."""
    text = (ROOT / "docs" / "gis.md").read_text(encoding="utf-8").partition("## Exports")[2]
    named = re.findall(r"^\| `([a-z]+)` \|", text, re.M)
    assert main(["export", "flight/frames-mosaic"]) == 0
    suits = set(re.findall(r"^│? *([a-z]+)  ", capsys.readouterr().out.partition("Commands")[2], re.M))
    assert suits - {"report", "layers"} <= set(named)
    shutil.rmtree("flight/frames-mosaic/work", ignore_errors=True)
    for name in named:
        run = "scene/run" if name == "map" else "flight/frames-mosaic"
        said = []
        for _ in range(2 if name in ("tiles", "footprints", "odm") else 1):
            assert main(["export", name, run]) == 0, capsys.readouterr().err
            said.append(capsys.readouterr().out)
        assert len(set(said)) == 1
        assert all(Path(line).exists() for line in said[0].splitlines()), said


def test_errors_and_codes_are_those_of_the_source() -> None:
    sources = (path.read_text(encoding="utf-8") for path in (ROOT / "geomosaic").rglob("*.py"))
    text = re.sub(r'"\s+f?"', "", "\n".join(sources))
    for line in (ROOT / "docs" / "errors.md").read_text(encoding="utf-8").splitlines():
        first = line.split("|")[1] if line.startswith("| `") else ""
        for quoted in re.findall(r"`([^`]+)`", first):
            assert quoted in text, quoted


def test_the_equations_name_modules_and_functions_that_are_there() -> None:
    text = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
    modules = re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", text)
    assert len(set(modules)) > 25
    for module in modules:
        assert (ROOT / "geomosaic" / module).is_file(), module
    for name, module in (
        ("shown", "adjustment/terms/image_observations"), ("redescending_weight", "estimation/robust"),
        ("stepped", "adjustment/problem/estimate"),
        ("common_error", "adjustment/procedure/common_offsets"), ("Readout", "adjustment/kernels/collinearity"),
    ):  # fmt: skip
        assert f"`{name}`" in text
        assert re.search(rf"^ *(?:def|class) {name}\b", (ROOT / f"geomosaic/{module}.py").read_text(), re.M)


def test_conda_s_environment_and_the_notice_know_all_that_is_needed() -> None:
    """The wheel is put into that environment without its dependencies."""
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    environment = (ROOT / "environment.yml").read_text(encoding="utf-8")
    notice = re.sub(r"\W", "", (ROOT / "NOTICE").read_text(encoding="utf-8").lower())
    for one in needed:
        name, _, bound = one.partition(">=")
        entry = rf"- (?:python-)?{name}(?:-python|>={re.escape(bound)})$"
        assert re.search(entry, environment, re.M), one
        assert re.sub(r"\W", "", name.removesuffix("-python-headless").removesuffix("2")) in notice, one


@pytest.mark.proof
def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-W", "ignore", "-m", "mkdocs", "build", "--strict", "--quiet", "-d", tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "stage" / "adjustment.solve.html").read_text(encoding="utf-8")
    assert "adjustment method" in page and 'href="matching.sift.html"' in page
    assert "https://" not in re.sub(r'<a [^>]*>|<link rel="canonical"[^>]*>|<!--.*?-->', "", page, flags=re.S)
