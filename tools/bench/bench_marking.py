"""How long a person takes to mark the targets of a survey in the browser: a scripted session in Chromium.

    python -m tools.bench.bench_marking [--lines 4] [--frames-per-line 5] [--targets 8] [--width-px 480]
                                        [--seed 1] [--out out/bench-marking] [--results docs/results/marking]

`geomosaic control` serves a simulated survey with painted targets, by the positions of the frames' tags. The
script visits each frame that is listed for each point, with refinement on: it looks, points, clicks, and
presses N. Where the target lies outside the frame it only presses N. It waits as a person does, so that the
page loads what it loads meanwhile:

- 1.35 s to look at each frame and decide, and 0.28 s for a key. These are the operators M and K of the
  keystroke-level model, for a person who is no trained typist (Card, Moran and Newell 1980);
- pointing from the last click by Fitts' law, -0.107 + 0.223 log2(D / W + 1) s for a mouse (MacKenzie, Sellen
  and Buxton 1991). W is 10 px, within which a click is refined;
- 0.2 s to press and release the button of the mouse (0.1 s each, operator B; Kieras 1993).

Clicks scatter by 1.5 px. The left hand stays on the keys and the right one on the mouse. What is slower than
these waits is the page: its time counts in full, and on a machine that others use it is longer than on an
idle one. The time of the session is the person's and the page's; the script's own queries of the page (where
the truth lies in the picture) are in `wall_s` only. Exit code 1 if the session takes five minutes or more,
or a mark is 1 px off the truth.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import json
import os
import platform
import shutil
import subprocess
import sys
import time
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))

import browser
from target_survey import TargetSurvey, target_survey

from tools.bench.bench_flights import commit

PROGRAM = Path(sys.executable).with_name("geomosaic")
MOST_S = 300.0
DECISION_S, KEY_S, CLICK_S = 1.35, 0.28, 0.2
FITTS_S = -0.107, 0.223
ACCEPTED_PX, SCATTER_PX = 10.0, 1.5
MOST_OFF_PX = 1.0
MOST_CLICKS = 3
"""On a target that the page says it cannot refine: a person looks again, and clicks closer."""
SIZE = 1280, 800
CHIP = "document.querySelector('#frames [aria-current=true]')"
SAID = "document.querySelector('#status').textContent"
Floats = np.ndarray[Any, np.dtype[np.float64]]


@dataclass
class Person:
    """Hands and eyes on a page. person_s, page_s: time that they took, and that the page took beyond it."""

    page: browser.Page
    rng: np.random.Generator
    actions: dict[str, int] = field(default_factory=lambda: {"decisions": 0, "keys": 0, "clicks": 0})
    person_s: float = 0.0
    page_s: float = 0.0
    at: Floats = field(default_factory=lambda: np.array(SIZE) / 2.0)

    def wait(self, seconds: float) -> None:
        self.person_s += seconds
        time.sleep(seconds)

    def decide(self) -> None:
        self.actions["decisions"] += 1
        self.wait(DECISION_S)

    def key(self, key: str) -> None:
        self.actions["keys"] += 1
        self.wait(KEY_S)
        begun = time.monotonic()
        self.page.send("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
        self.page.send("Input.dispatchKeyEvent", type="keyUp", key=key)
        self.page_s += time.monotonic() - begun

    def click(self, at: Floats) -> None:
        self.actions["clicks"] += 1
        self.wait(pointing_s(float(np.linalg.norm(at - self.at))) + CLICK_S)
        self.at = at
        x, y = (at + SCATTER_PX * self.rng.standard_normal(2)).tolist()
        begun = time.monotonic()
        for kind in ("mousePressed", "mouseReleased"):
            self.page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        self.page_s += time.monotonic() - begun

    def see(self, script: str) -> None:
        begun = time.monotonic()
        self.page.until(script)
        self.page_s += time.monotonic() - begun


def pointing_s(distance_px: float) -> float:
    """Fitts' time to move the mouse so far."""
    a, b = FITTS_S
    return max(a + b * float(np.log2(distance_px / ACCEPTED_PX + 1.0)), 0.0)


def session(person: Person, url: str, survey: TargetSurvey) -> int:
    """Marks all targets in all frames that are listed for them. Returns the number of marks."""
    page = person.page
    survey = json.load(urllib.request.urlopen(f"{url}survey"))
    frames, points = ([of["name"] for of in survey[key]] for key in ("frames", "points"))
    marks = 0
    for k, name in enumerate(points):
        person.key("j")
        person.see(f"document.querySelectorAll('.point')[{k}].ariaCurrent === 'true'")
        for n in range(int(page.run("document.querySelectorAll('#frames button').length"))):
            if n:
                person.key("n")
            person.see(f"[...document.querySelectorAll('#frames button')].indexOf({CHIP}) === {n}")
            shown = page.run(f"{CHIP}.firstChild.textContent")
            person.decide()
            true_px = survey.truth[name].get(shown)
            if true_px is None:
                continue
            state = json.load(urllib.request.urlopen(f"{url}state"))["points"][k]["frames"]
            entry = next(of for of in state if frames[of["frame"]] == shown)
            box = "document.querySelector('#frame').getBoundingClientRect()"
            middle = page.run(f"(b => [b.left + b.width / 2, b.top + b.height / 2])({box})")
            for again in range(MOST_CLICKS):
                if again:
                    person.decide()
                page.run("document.querySelector('#status').textContent = ''")
                person.click(np.add(middle, np.subtract(true_px, entry["predicted"])))
                person.see(f"{SAID} !== ''")
                if not page.run(f"{SAID}.startsWith('no corner')"):
                    break
            marks += 1
    return marks


def off_px(table: Path, survey: TargetSurvey) -> Floats:
    """Distances of the marks in gcp.csv from the truth."""
    with table.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["image"]]
    marked = np.array([(float(row["col"]), float(row["row"])) for row in rows]).reshape(-1, 2)
    true = np.array([survey.truth[row["name"]][row["image"]] for row in rows]).reshape(-1, 2)
    return np.asarray(np.linalg.norm(marked - true, axis=1))


def measured(survey: TargetSurvey, out: Path, seed: int) -> dict[str, Any]:
    """A session's figures."""
    command = [PROGRAM, "control", survey.frames, "--points", survey.rover, "--camera", survey.camera]
    command += ["-o", out / "marks", "-q"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        url = server.stdout.readline().split()[-1]
        with browser.browser(out / "profile") as page:
            page.open(url, *SIZE)
            page.until("document.querySelectorAll('.point').length > 0")
            page.run("document.querySelector('#always').click()")
            person = Person(page, np.random.default_rng(seed))
            begun = time.monotonic()
            marks = session(person, url, survey)
            wall_s = time.monotonic() - begun
            errors = page.errors
        server.terminate()
        server.stdout.read()
    found = off_px(out / "marks" / "gcp.csv", survey)
    return {
        "seconds": round(person.person_s + person.page_s, 1),
        "wall_s": round(wall_s, 1),
        "person_s": round(person.person_s, 1),
        "page_s": round(person.page_s, 1),
        "marks": marks,
        **person.actions,
        "median_off_px": round(float(np.median(found)), 3),
        "most_off_px": round(float(found.max()), 3),
        "errors": errors,
    }


def main() -> int:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--lines", type=int, default=4)
    ask.add_argument("--frames-per-line", type=int, default=5)
    ask.add_argument("--targets", type=int, default=8)
    ask.add_argument("--width-px", type=int, default=480, help="of the frames, which are 4 : 3")
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--patience-s", type=float, default=60.0, help="for one thing of the page")
    ask.add_argument("--out", type=Path, default=Path("out/bench-marking"))
    ask.add_argument("--results", type=Path, help="without suffix, such as docs/results/marking")
    asked = ask.parse_args()
    if not any(map(shutil.which, browser.NAMES)):
        print("skipped: no Chromium. apt-get install chromium")
        return 0
    browser.PATIENCE_S = asked.patience_s
    shutil.rmtree(asked.out, ignore_errors=True)
    asked.out.mkdir(parents=True)
    size = {"width_px": asked.width_px, "height_px": asked.width_px * 3 // 4}
    flight = {"lines": asked.lines, "frames_per_line": asked.frames_per_line, **size}
    survey = target_survey(asked.out / "flight", control_points=asked.targets, seed=asked.seed, **flight)
    found = measured(survey, asked.out, asked.seed)
    right = found["seconds"] < MOST_S and found["most_off_px"] < MOST_OFF_PX and not found["errors"]
    whole = {
        "title": "Marking in the browser",
        "command": f"python -m tools.bench.bench_marking --width-px {asked.width_px} --seed {asked.seed}",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores of a shared machine, {platform.machine()}",
        "load": round(os.getloadavg()[2], 1),
        "commit": commit(),
        "frames": asked.lines * asked.frames_per_line,
        "targets": asked.targets,
        "width_px": asked.width_px,
        "most_s": MOST_S,
        **found,
        "right": right,
    }
    print(json.dumps(whole, indent=1))
    if asked.results:
        asked.results.with_suffix(".json").write_text(json.dumps(whole, indent=1) + "\n")
    return 0 if right else 1


if __name__ == "__main__":
    raise SystemExit(main())
