"""The command line as a user meets it: exit codes, one line for each failure, real processes where they count."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from pipeline_toy import distribution, recipe_file

from geomosaic.cli.main import main
from geomosaic.pipeline.registry import installed
from geomosaic.pipeline.run_folder import MARKER
from geomosaic.recording.file.reader import read_recording

TESTS = Path(__file__).parents[1]
COMMAND = [sys.executable, "-m", "geomosaic.cli.main"]


class Desk:
    """A folder to work in, with the toy stages installed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        recipe_file(folder)
        self.site = distribution(folder / "site")
        self.log = folder / "log"
        path = os.pathsep.join([str(self.site), str(TESTS / "support"), str(TESTS.parent)])
        self.environment = {**os.environ, "PYTHONPATH": path, "TOY_LOG": str(self.log), "COLUMNS": "120"}

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*COMMAND, *arguments],
            cwd=self.folder,
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def run(self, *arguments: str) -> tuple[int, str, str]:
        process = self.start(*arguments)
        out, err = process.communicate(timeout=60)
        return process.returncode, out, err

    def ask(self, *arguments: str) -> tuple[int, str, str]:
        """As `run` does, in this process."""
        out, err = io.StringIO(), io.StringIO()
        with (
            contextlib.chdir(self.folder), patch.dict(os.environ, self.environment),
            patch.object(sys, "path", [str(self.site), *sys.path]),
            contextlib.redirect_stdout(out), contextlib.redirect_stderr(err),
        ):  # fmt: skip
            importlib.invalidate_caches()
            installed.cache_clear()
            try:
                return main(arguments), out.getvalue(), err.getvalue()
            finally:
                installed.cache_clear()
                sys.modules.pop("plugin_toy", None)

    def done(self) -> list[str]:
        lines = self.log.read_text().split("\n")[:-1] if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return lines

    def wait_for(self, line: str) -> None:
        for _ in range(600):
            if self.log.exists() and line in self.log.read_text().split("\n"):
                return
            time.sleep(0.05)
        raise AssertionError(f"never came to {line}")


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def in_session(session: int) -> list[str]:
    """The command lines of the processes of a session that are still alive."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and fields[0] != "Z":
                found.append(stat.with_name("cmdline").read_text().replace("\0", " "))
        except (OSError, ValueError):
            continue
    return found


def gone(session: int, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if not in_session(session):
            return True
        time.sleep(0.05)
    return False


def test_a_run_says_where_its_results_lie(desk: Desk) -> None:
    code, out, err = desk.ask("run", "toy.yaml", "-o", "run", "--set", "toy.power.power=3", "--workers", "1")
    assert code == 0
    assert out == (
        "total      run/total.txt\nnotes      run/notes.txt\nrecording  run/run.mcap\n"
        "warnings   1, see above and run.json\nframes     3 tied\n"
    )
    lines = err.splitlines()
    assert lines[0] == "warning: four.jpg: 4 numbers are many"
    assert lines[2].startswith("[2/5] Raise to a power: ") and len(lines) == 6
    assert (desk.folder / "run" / "total.txt").read_text().startswith("100.0 ")
    code, _, err = desk.ask("run", "toy.yaml", "-o", "run", "--set", "toy.power.power=3", "--workers", "1")
    assert "[2/5] Raise to a power: unchanged, from the cache" in err


@pytest.mark.parametrize(("output", "code"), [("stdout", 141), ("stderr", 0)])
def test_a_closed_pipe_is_no_fault(output: str, code: int, desk: Desk) -> None:
    """`geomosaic run ... | head`, and the same of stderr: the work is done all the same."""
    reader, writer = os.pipe()
    os.close(reader)
    other = {"stdout": "stderr", "stderr": "stdout"}[output]
    process = subprocess.run(
        [*COMMAND, "run", "toy.yaml", "-o", "run", "--workers", "1"],
        cwd=desk.folder,
        env=desk.environment,
        text=True,
        timeout=60,
        **{output: writer, other: subprocess.PIPE},
    )
    os.close(writer)
    stream = getattr(process, other)
    assert process.returncode == code, stream
    assert "Traceback" not in stream and "geomosaic:" not in stream and len(stream.splitlines()) >= 3
    assert json.loads((desk.folder / "run" / "run.json").read_text())["frames"]["total"] == 4


@pytest.mark.parametrize("arguments", [["stages"], ["stages", "--json"], ["--version"]])
def test_a_full_disk_under_the_output_is_named(arguments: list[str], desk: Desk) -> None:
    """It counted as a fault of geomosaic."""
    with Path("/dev/full").open("w") as full:
        process = subprocess.run(
            [*COMMAND, *arguments],
            env=desk.environment,
            text=True,
            timeout=60,
            stdout=full,
            stderr=subprocess.PIPE,
        )
    line = "geomosaic: standard output: can't be written (No space left on device); free some space\n"
    assert (process.returncode, process.stderr) == (2, line)


def test_a_run_goes_on_where_the_disk_of_its_progress_is_full(desk: Desk) -> None:
    arguments = [*COMMAND, "run", "toy.yaml", "-o", "run", "--workers", "1"]
    with Path("/dev/full").open("w") as full:
        process = subprocess.run(
            arguments, cwd=desk.folder, env=desk.environment, stderr=full, stdout=subprocess.PIPE, timeout=60
        )
    assert process.returncode == 0 and (desk.folder / "run" / "run.json").exists()


def test_a_failure_that_nobody_hears_keeps_its_exit_code(desk: Desk) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    arguments = [*COMMAND, "stages", "nothing"]
    assert subprocess.run(arguments, env=desk.environment, stderr=writer, timeout=60).returncode == 2
    os.close(writer)


def test_a_terminal_shows_a_bar_with_the_time_left(desk: Desk) -> None:
    ours, theirs = os.openpty()
    arguments = ["run", "toy.yaml", "-o", "run", "--workers", "1", "--set", "toy.power.delay_s=0.3"]
    process = subprocess.Popen([*COMMAND, *arguments], cwd=desk.folder, env=desk.environment, stderr=theirs)
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 4096)
        except OSError:
            break
        if not part:
            break
        shown += part
    os.close(ours)
    assert process.wait() == 0
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.decode())
    assert re.search(r"\[2/5\] Raise to a power \S+ 0:00:0\d 2/4, time left \S+ +powers", text)
    assert "warning: four.jpg: 4 numbers are many" in text
    assert re.search(r"\[2/5\] Raise to a power: \d+\.\d s", text)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["rn"], "unknown command 'rn'; did you mean 'run'?"),
        (["run"], "Missing argument 'RECIPE'."),
        (["run", "toy.yaml", "-o", "r", "--workers", "x"], "Invalid value for '--workers'"),
        (["run", "no.yaml", "-o", "r"], "no.yaml: there is no such file; give a recipe"),
        (["run", "toy.yaml", "-o", "/proc/r"], "/proc/r: the folder can't be made; choose another output"),
        (["run", "toy.yaml", "-o", "toy.yaml"], "toy.yaml: a file stands where a folder is needed; choose"),
        (
            ["run", "toy.yaml", "-o", "r", "--set", "toy.power.power=10"],
            "--set toy.power.power=10: must be a whole number, 1 to 9",
        ),
        (
            ["run", "toy.yaml", "-o", "r", "--frames", "d"],
            "--frames d: unknown stage of this recipe 'survey.read'; did you mean 'toy.",
        ),
        (["stages", "toy.powr"], "unknown stage 'toy.powr'; did you mean 'toy.power'?"),
        (["evaluate", "run", "--reference", "x"], ""),
        (["export", "nothing", "run"], "unknown command 'nothing'"),
    ],
)
def test_bad_usage_is_one_line_and_exit_2(arguments: list[str], line: str, desk: Desk) -> None:
    before = {p.name for p in desk.folder.iterdir()}
    code, out, err = desk.ask(*arguments)
    assert code == 2 and out == ""
    assert err.startswith("geomosaic: ") and err.count("\n") == 1
    assert line in err
    assert {p.name for p in desk.folder.iterdir()} == before


def test_a_fault_is_one_line_exit_1_and_has_a_traceback_on_demand(desk: Desk) -> None:
    desk.folder.joinpath("numbers.txt").write_text("one")
    code, _, err = desk.ask("run", "toy.yaml", "-o", "run", "--workers", "1")
    assert code == 1 and err.count("\n") == 1
    assert err.startswith(
        "geomosaic: stage toy.read of toys 1.2 failed: ValueError: could not convert string"
    )
    desk.environment["GEOMOSAIC_TRACEBACK"] = "1"
    code, _, err = desk.ask("run", "toy.yaml", "-o", "run", "--workers", "1")
    assert code == 1 and "pipeline_toy.py" in err and "Traceback" in err


@pytest.mark.parametrize("workers", [pytest.param("1", marks=pytest.mark.proof), "2"])
def test_ctrl_c_ends_quickly_with_130_and_the_work_is_kept(workers: str, desk: Desk) -> None:
    desk.folder.joinpath("numbers.txt").write_text(" ".join(str(i) for i in range(200, 216)))
    arguments = ["run", "toy.yaml", "-o", "run", "--set", "toy.power.delay_s=0.2", "--workers", workers]
    process = desk.start(*arguments)
    desk.wait_for("item 203")
    started = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert time.monotonic() - started < 5.0
    assert err.splitlines()[-1] == "geomosaic: stopped" and "Traceback" not in err and out == ""
    assert gone(process.pid, 5.0), in_session(process.pid)
    assert not (desk.folder / "run" / "run.json").exists()
    recording = read_recording(desk.folder / "run" / "run.mcap")
    assert recording.whole and recording.warnings[-1].text == "stopped by the user"
    before = desk.done()
    assert desk.run(*arguments)[0] == 0
    after = desk.done()
    assert "read" in before and "read" not in after
    assert "item 200" in before and "item 200" not in after
    assert len({*before, *after} & {f"item {i}" for i in range(200, 216)}) == 16


def test_a_killed_run_leaves_no_orphans_and_resumes_where_it_was(desk: Desk) -> None:
    desk.folder.joinpath("numbers.txt").write_text(" ".join(str(i) for i in range(200, 220)))
    arguments = ["run", "toy.yaml", "-o", "run", "--workers", "2", "--set", "toy.power.delay_s=0.2"]
    process = desk.start(*arguments)
    desk.wait_for("item 207")
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)
    assert process.returncode == -signal.SIGKILL
    assert gone(process.pid, 5.0), in_session(process.pid)
    recording = read_recording(desk.folder / "run" / "run.mcap")
    assert not recording.whole and recording.stages[0].finished
    assert sorted(p.name for p in (desk.folder / "run").iterdir()) == [MARKER, "run.mcap", "work"]
    before = desk.done()
    assert desk.run(*arguments)[0] == 0
    after = desk.done()
    again = {line for line in before if line.startswith("item")} & set(after)
    assert len(again) <= 4 and "item 200" not in after and "read" not in after
    total = float((desk.folder / "run" / "total.txt").read_text().split()[0])
    assert total == sum(i**2 for i in range(200, 220))


def test_stages_are_listed_and_described(desk: Desk) -> None:
    code, out, _ = desk.ask("stages", "toy.power")
    assert code == 0
    assert "takes: numbers (Numbers)\ngives: numbers (Numbers)\n" in out
    assert "  step_m: step (number or 'auto' m from 0.01; default auto)\n" in out
    assert "  name: manner (plain, fancy; default plain)\n" in out
    code, out, _ = desk.ask("stages", "--json")
    listed = json.loads(out)
    power = next(s for s in listed["stages"] if s["id"] == "toy.power")
    assert power["params"][0] == {
        "name": "power", "type": "whole number", "unit": "", "min": 1, "max": 9, "choices": [], "default": 2,
        "required": False, "help": "exponent", "affects_output": True,
    }  # fmt: skip


def test_a_broken_plugin_is_listed_and_exits_2_when_asked_for(desk: Desk) -> None:
    distribution(desk.folder / "site", "bad", {"toy.bad": "no_such_module:X"})
    code, out, _ = desk.ask("stages")
    assert code == 0 and "BROKEN: stage toy.bad can't be loaded" in out
    assert "Raise to a power (Toy, version 3)" in out
    code, _, err = desk.ask("stages", "toy.bad")
    assert code == 2 and err.startswith(
        "geomosaic: stage toy.bad can't be loaded from no_such_module:X (bad 1.2)"
    )


PLUGIN = '''
from typing import ClassVar
from pipeline_toy import Total
from geomosaic.pipeline.stage import RunFile, Stage, StageParams, param

class Simulate(Stage):
    """Simulates a toy."""
    id = "simulate.toy"
    display_name = "Simulate a toy"
    group = "Simulation"
    outputs: ClassVar = {}
    class Params(StageParams):
        height_m: float = param(80.0, help="flying height", unit="m", ge=1, le=9000)
        kind: str = param("block", help="plan", choices=["block", "line"])
        turned: bool = param(False, help="turn some")
    def run(self, inputs, params, context):
        with context.writing("toy.txt") as path:
            path.write_text(f"{params.height_m} {params.kind} {params.turned}")
        return {}

class Export(Stage):
    """Exports a toy."""
    id = "export.toy"
    display_name = "Export a toy"
    group = "Export"
    inputs: ClassVar = {"total": Total, "total_file": RunFile}
    outputs: ClassVar = {"toy_file": RunFile}
    class Params(StageParams):
        digits: int = param(2, help="digits", ge=0, le=9)
    def run(self, inputs, params, context):
        text = context.path_of(inputs["total_file"]).read_text().split()[0]
        assert float(text) == inputs["total"].value
        with context.writing("export.txt") as path:
            total, tied = inputs["total"].value, context.summary()["frames"]["tied"]
            path.write_text(f"{total:.{params.digits}f} {tied}")
        return {"toy_file": context.run_file("export.txt")}
'''


@pytest.fixture
def plugged(desk: Desk) -> Desk:
    desk.folder.joinpath("site", "plugin_toy.py").write_text(PLUGIN)
    names = {"simulate.toy": "Simulate", "export.toy": "Export"}
    distribution(desk.folder / "site", "plug", {id: f"plugin_toy:{name}" for id, name in names.items()})
    return desk


def test_simulate_has_the_options_its_stage_declares(plugged: Desk) -> None:
    code, out, _ = plugged.ask("simulate", "toy", "--help")
    text = " ".join(out.split())
    assert code == 0 and "flying height (a number in m, 1 to 9000) [80.0]" in text
    assert "--turned / --no-turned" in text or "--turned/--no-turned" in text
    code, out, _ = plugged.ask("simulate", "toy", "out", "--height-m", "12.5", "--turned", "--seed", "3")
    assert (code, out) == (0, "out/toy.txt\n")
    assert (plugged.folder / "out" / "toy.txt").read_text() == "12.5 block True"
    assert {p.name for p in (plugged.folder / "out").iterdir()} == {MARKER, "toy.txt"}
    code, _, err = plugged.ask("simulate", "toy", "out", "--kind", "blok")
    assert code == 2
    assert err.startswith("geomosaic: --kind 'blok': must be one of block, line (did")
    code, _, err = plugged.ask("simulate", "toy", "out", "--height-m", "0")
    assert code == 2 and "--height-m 0.0: must be a number in m, 1 to 9000" in err


def test_export_works_on_a_finished_run(plugged: Desk) -> None:
    code, _, err = plugged.ask("export", "toy", "run")
    assert code == 2 and "run: is no finished run (run.json is missing); give a run's folder" in err
    assert plugged.ask("run", "toy.yaml", "-o", "run", "--workers", "1")[0] == 0
    code, out, _ = plugged.ask("export", "toy", "run", "--digits", "3")
    assert (code, out) == (0, "run/export.txt\n")
    assert (plugged.folder / "run" / "export.txt").read_text() == "30.000 3"


def test_evaluate_takes_a_run_or_an_image(desk: Desk) -> None:
    truth = np.kron(np.random.default_rng(5).integers(0, 255, (100, 100)), np.ones((3, 3))).astype(np.uint8)
    truth = np.asarray(cv2.GaussianBlur(truth, (0, 0), 1.5))
    desk.folder.joinpath("run").mkdir()
    for name, east_m in (("truth.tif", 500000.0), ("run/mosaic.tif", 500000.5)):
        with rasterio.open(
            desk.folder / name,
            "w",
            "GTiff",
            300,
            300,
            1,
            "EPSG:32615",
            Affine(0.25, 0, east_m, 0, -0.25, 5e6),
            np.uint8,
        ) as file:
            file.write(truth, 1)
    found = []
    for target in ("run", "run/mosaic.tif"):
        code, out, err = desk.ask("evaluate", target, "--reference", "truth.tif", "--json")
        assert code == 0, err
        found.append(json.loads(out))
    assert found[0].pop("mosaic") == "run/mosaic.tif" and found[1].pop("mosaic") == "run/mosaic.tif"
    assert found[0] == found[1]
    code, out, _ = desk.ask("evaluate", "run", "--reference", "truth.tif")
    assert code == 0 and out.count("\n") > 3
    code, _, err = desk.ask("evaluate", "run", "--reference", "none.tif")
    assert code == 2
    assert "none.tif: no such file or folder; give an existing one with --reference PATH" in err
    code, _, err = desk.ask("evaluate", "nowhere.tif", "--reference", "truth.tif")
    assert code == 2
    assert err == "geomosaic: nowhere.tif: no such file; give a finished run's folder or a GeoTIFF\n"


def test_doctor_finds_the_installation_sound(desk: Desk) -> None:
    code, out, _ = desk.run("doctor", "--json")
    states = {c["name"]: c["state"] for c in json.loads(out)}
    needed = ["versions", "GDAL bindings", "GDAL drivers", "osgeo and rasterio", "OpenCV"]
    assert {name: states[name] for name in needed} == dict.fromkeys(needed, "ok")
    assert code == (1 if "broken" in states.values() else 0)


def test_the_command_line_loads_nothing_heavy() -> None:
    code = (
        "import sys, geomosaic.cli.app as m; m.build_app();"
        "print([n for n in ('cv2','rerun','osgeo','rasterio','numpy','scipy','pyproj') if n in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_a_run_loads_no_library_before_a_stage_needs_it() -> None:
    code = (
        "import sys, geomosaic.pipeline.runner;"
        "print([n for n in ('osgeo', 'rasterio', 'scipy') if n in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_help_names_units_and_defaults(desk: Desk) -> None:
    code, out, _ = desk.ask("mosaic", "--help-all")
    assert code == 0
    for option in ("--pos", "--camera", "--dem-offset", "--gcp", "--crs", "--gsd", "--adjust", "--reference"):
        assert option in out
    code, out, err = desk.ask()
    assert code == 2 and err.startswith("Usage: geomosaic") and out == ""
    assert desk.ask("--version")[:2] == (0, "geomosaic 0.1.0\n")
