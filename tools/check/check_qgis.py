"""Makes a small run of frames and one of strips. A real QGIS then opens all that is written for it, and runs
and cancels the algorithms of its toolbox.

What QGIS must be able to do stands in `qgis_window.py`, which QGIS' own Python runs.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tools.bench.result_rows import RowKind, add_options, write_rows
from tools.docs.results_page import GIS

HERE = Path(__file__).parent
PYTHONS = ("/usr/bin/python3", "python3", "/Applications/QGIS.app/Contents/MacOS/bin/python3")
ROWS = {
    "layers": RowKind(
        GIS,
        "layers with all expressions and styles in QGIS {version}",
        "all",
        "{good:d} of {layers:d}",
        measured=("version",),
    )
}
OFFSCREEN = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
for _name in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"):
    OFFSCREEN.pop(_name, None)


def geomosaic(*arguments: str | Path) -> None:
    """Runs a command of geomosaic; ends the check if it fails."""
    command = [sys.executable, "-m", "geomosaic.cli.main", *map(str, arguments)]
    if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode:
        sys.exit(f"check-qgis: geomosaic {arguments[0]} failed")


def qgis_python() -> str:
    """The Python that has QGIS' modules."""
    for name in PYTHONS:
        found = shutil.which(name)
        if (
            found
            and not subprocess.run(
                [found, "-c", "import qgis.core"], check=False, capture_output=True, env=OFFSCREEN
            ).returncode
        ):
            return found
    sys.exit("check-qgis: no Python here has QGIS; on Debian and Ubuntu: apt install qgis python3-qgis")


def frames_run(out: Path) -> Path:
    """Simulated frames with control points, over hills with trees, whose surface is matched."""
    survey, run = out / "survey", out / "run"
    if not (run / "run.json").exists():
        hills = ("--control-points", "6", "--relief-m", "12", "--trees-stand")
        geomosaic("simulate", "frames", survey, *hills, "--overwrite")
        drawn = ("hillshade=true", "contours_m=2")
        geomosaic(
            "mosaic", survey / "frames", "-o", run, "--pos", survey / "pos.csv", "--camera",
            survey / "cameras.json", "--gcp", survey / "gcp_list.txt", "--surface", "dense",
            *(word for one in drawn for word in ("--set", f"export.surface.{one}")),
        )  # fmt: skip
    return run


def strips_run(out: Path) -> Path:
    """A simulated scene of four strips."""
    strips, run = out / "strips", out / "strips-run"
    if not (run / "run.json").exists():
        geomosaic("simulate", "strips", strips, "--ccds", "4", "--lines", "4096", "--overwrite")
        geomosaic("strips", strips / "geometry.yaml", "-o", run, "--map")
    return run


def processing(python: str, out: Path) -> None:
    """The algorithms in QGIS' toolbox: one runs, one is cancelled."""
    home, run = (out / "home").absolute(), (out / "by-qgis").absolute()
    folder = home / "QGIS/QGIS3/profiles/default/processing/scripts"
    geomosaic("qgis-script", folder)
    survey = (out / "survey").absolute()
    # Debian's `qgis_process` hands on an option that only the window knows; the program itself doesn't.
    program = shutil.which("qgis_process.bin") or shutil.which("qgis_process")
    if program is None:
        sys.exit("check-qgis: there is no qgis_process")
    words = [
        f"SURVEY_READ_FRAMES={survey / 'frames'}", f"SURVEY_READ_POS={survey / 'pos.csv'}",
        f"SURVEY_READ_CAMERA={survey / 'cameras.json'}", "MOSAIC_SEAMS_GSD_M=0.2", f"OUTPUT={run}",
    ]  # fmt: skip
    command = [program, "run", "script:geomosaic_mosaic", "--", *words]
    environment = {**OFFSCREEN, "XDG_DATA_HOME": str(home)}
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    if done.returncode or "100 - done" not in done.stdout or not (run / "mosaic.tif").exists():
        sys.exit(f"check-qgis: qgis_process failed\n{done.stdout}{done.stderr}")
    print(
        "  qgis_process run script:geomosaic_mosaic: "
        + done.stdout.split("verdict")[1].split("\n")[0].strip()
    )
    script = str(folder / "geomosaic_mosaic.py")
    cancel = [python, str(HERE / "qgis_cancel.py"), script, str(survey / "frames"), str(out / "cancelled")]
    if code := subprocess.run(cancel, check=False, env=OFFSCREEN).returncode:
        sys.exit(code)


def main() -> None:
    """Opens each run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/check-qgis"))
    parser.add_argument("--run", type=Path, help="open this finished run instead")
    parser.add_argument("window", nargs="*", help="options of qgis_window.py, after --")
    add_options(parser)
    options = parser.parse_args()
    python, out = qgis_python(), options.out
    out.mkdir(parents=True, exist_ok=True)
    runs = [frames_run(out), strips_run(out)] if options.run is None else [options.run]
    found: list[dict[str, str | int]] = []
    for run in runs:
        picture = out / f"{run.name}.png"
        command = [python, str(HERE / "qgis_window.py"), str(run), "--picture", str(picture)]
        counts = out / f"{run.name}-layers.json"
        counts.unlink(missing_ok=True)
        command += ["--counts", str(counts)]
        done = subprocess.run([*command, *options.window], check=False, env=OFFSCREEN)
        if counts.exists():
            found.append(json.loads(counts.read_text(encoding="utf-8")))
        if done.returncode:
            break
    if found:
        good, layers = (sum(int(of[key]) for of in found) for key in ("good", "layers"))
        row = ROWS["layers"].row(good == layers, version=found[0]["version"], good=good, layers=layers)
        write_rows(options, [row])
    if done.returncode:
        sys.exit(done.returncode)
    if options.run is None:
        processing(python, out)


if __name__ == "__main__":
    main()
