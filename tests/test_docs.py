"""What the documents show is so: every command parses, those of the guides run, errors and codes exist."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer

import geomosaic as gm
from geomosaic.cli.app import build_app
from geomosaic.cli.main import main

ROOT = Path(__file__).parents[1]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *ROOT.glob("*.md"), *(ROOT / "examples").glob("*/*.md")])
GUIDES = ("index", "start", "howto", "python")
SMALL = "--lines 1 --frames-per-line 4 --width-px 320 --height-px 240"
"""A flight of four small frames does where people simulate a usual one."""


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


def shown(page: Path) -> Iterator[tuple[str, bool]]:
    """Commands of a page, and whether they stand by themselves, not in a sentence."""
    text = page.read_text(encoding="utf-8")
    for line in re.findall(r"^(?: {4})?(?:\.venv/bin/)?(geomosaic [a-z].*)$", text, re.M):
        yield line, True
    for line in re.findall(r"`(geomosaic [a-z][^`\n]*)`", text):
        yield line, False


def words(line: str) -> list[str]:
    """A command's words, without its comment and what is left to choose."""
    line = re.split(r" {2,}|\s#", line)[0]
    return shlex.split(re.sub(r"\[[^]]*\]|\.\.\.", "", line))[1:]


def parse(argv: list[str]) -> None:
    """As the command line does it, but for doing it. Raises: `click.UsageError`."""
    command: click.Command = typer.main.get_command(build_app(argv))
    context, rest, name = None, argv, "geomosaic"
    while True:
        context = command.make_context(name, rest, parent=context)
        if not isinstance(command, click.Group):
            return
        asked, found, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        assert asked is not None and found is not None
        command, name = found, asked


@pytest.mark.parametrize("page", [p for p in PAGES if "geomosaic " in p.read_text()], ids=lambda p: p.name)
def test_every_command_is_one(page: Path) -> None:
    for line, alone in shown(page):
        if "(" in line or re.search(r"\b(frames|run)\|", line):
            continue
        with contextlib.redirect_stdout(io.StringIO()):
            try:
                parse(words(line))
            except (click.MissingParameter, click.exceptions.NoArgsIsHelpError):
                assert not alone, line
            except click.exceptions.Exit:
                pass
            except click.UsageError as error:
                raise AssertionError(f"{line}: {error.format_message()}") from error


def test_what_commands_name_is_there() -> None:
    """Targets of make, the tools, recipes by name, and parameters of stages that --set and tables name."""
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    known = {f"{id}.{p['name']}" for id, stage in gm.stages().items() for p in stage["params"]}
    recipes = {path.stem.replace("_", "-") for path in (ROOT / "geomosaic" / "recipes").glob("*.yaml")}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"(?:^ *|`)make ((?!-)[a-z][a-z-]*)(?=[`\s])", text, re.M):
            assert target in targets, f"{page.name}: make {target}"
        for tool in re.findall(r"\b(tools/\w+\.(?:py|sh))\b", text):
            assert (ROOT / tool).is_file(), f"{page.name}: {tool}"
        for name in re.findall(r"--set ([a-z_]+\.[a-z_0-9]+\.[a-z_0-9]+)=", text):
            example = ROOT / "examples" in page.parents  # stages of its own, which its own tests know
            assert name in known or example, f"{page.name}: --set {name}"
        for name in re.findall(r"geomosaic run ([a-z][a-z-]*)(?=[ `\n])", text):
            assert name in recipes, f"{page.name}: geomosaic run {name}"


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
            if argv[0] == "evaluate":
                argv += ["--set", "quality.compare.patch_px=48", "--set", "quality.compare.search_px=32"]
            code = main(argv)
            told = capsys.readouterr()
            assert code == 0 or (argv[0], code) == ("diff", 1), f"{line}\n{told.out}{told.err}"
    assert (desk / "flight" / "frames-mosaic" / "mosaic.tif").is_file()
    for block in blocks(ROOT / "docs" / "python.md", "python"):
        exec(block.replace(", set={", ", workers=1, set={"), globals())


def test_errors_and_codes_are_those_of_the_source() -> None:
    sources = (path.read_text(encoding="utf-8") for path in (ROOT / "geomosaic").rglob("*.py"))
    text = re.sub(r'"\s+f?"', "", "\n".join(sources))
    for line in (ROOT / "docs" / "errors.md").read_text(encoding="utf-8").splitlines():
        first = line.split("|")[1] if line.startswith("| `") else ""
        for quoted in re.findall(r"`([^`]+)`", first):
            assert quoted in text, quoted


def test_the_equations_name_modules_and_functions_that_are_there() -> None:
    text = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
    modules = re.findall(r"`([a-z_]+/[a-z_]+\.py)`", text)
    assert len(set(modules)) > 25
    for module in modules:
        assert (ROOT / "geomosaic" / module).is_file(), module
    for name, module in (
        ("share_shown", "adjustment/bundle_equations"), ("lie_weight", "adjustment/robust"),
        ("stepped", "adjustment/bundle_model"), ("common_error", "adjustment/variance"),
        ("Readout", "adjustment/collinearity"),
    ):  # fmt: skip
        assert f"`{name}`" in text
        assert re.search(rf"^(?:def|class) {name}\b", (ROOT / f"geomosaic/{module}.py").read_text(), re.M)


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


def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-W", "ignore", "-m", "mkdocs", "build", "--strict", "--quiet", "-d", tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "stage" / "adjustment.solve.html").read_text(encoding="utf-8")
    assert "adjustment method" in page and 'href="matching.sift.html"' in page
    assert "https://" not in re.sub(r'<a [^>]*>|<link rel="canonical"[^>]*>|<!--.*?-->', "", page, flags=re.S)
