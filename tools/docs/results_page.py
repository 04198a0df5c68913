"""Writes docs/results.md from the files in docs/results.

    .venv/bin/python tools/docs/results_page.py [--results DIR] [--out FILE]

Each benchmark's JSON gives rows of a table. `summary.json` gives the rows of benchmarks that write no JSON,
notes and pictures. A row has what, target, value, met (true, false or null), command and date. Rows that miss
their target come first. A file that is absent, or a case that is absent in it, gives no row.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geomosaic.quality.figures import circle_of, interval_of

FOLDER = Path("docs/results")
QUESTIONS = (
    "Does a folder of frames become a map?",
    "Is the map right on surveys with faults?",
    "Is the stated accuracy true?",
    "How accurate is the block?",
    "Are faults of the survey named?",
    "How good is the dense surface?",
    "How good does the mosaic look?",
    "How fast is it, and how much memory does it need?",
    "How does the bundle adjustment compare with the methods of the paper?",
    "How accurate are the seams of CCD strips?",
    "What does the recording cost?",
    "Is it safe with damaged files and interrupted runs?",
    "Does it work in a GIS and on a new machine?",
    "Is the reflectance of multispectral frames right?",
    "Can others carry the code on?",
)
(
    FLIGHTS,
    DIRTY,
    STATED,
    BLOCK,
    FAULTS,
    SURFACE,
    LOOKS,
    FAST,
    PAPER,
    STRIPS,
    RECORDED,
    SAFE,
    GIS,
    REFLECTED,
    HOUSE,
) = QUESTIONS
SIGNIFICANT = 2.6
"""Standard deviations beyond which a slope differs from 0 (99 %)."""
HEAD = """# Results

This page is generated: `make results` reads the files in `docs/results` and writes it.
Each row has its target, the value that was measured, the command that measures it again, and the date.
Rows that miss their target stand first. The machine has two cores, shared with other work.
"""


@dataclass(frozen=True)
class Row:
    """One measured statement. met: None where there is no target."""

    question: str
    what: str
    target: str
    value: str
    met: bool | None
    command: str
    date: str

    def line(self) -> str:
        value = f"**{self.value}**" if self.met is False else self.value
        cells = (self.what, self.target, value, f"`{self.command}`", self.date)
        return f"| {' | '.join(cell.replace('|', '/') or '-' for cell in cells)} |"


_COMPARED = (("processor_s", " s", 1.0), ("centres_after_mm", " mm", 1.0), ("ssim", "", -1.0))
"""Figures of other programs next to geomosaic's: key, unit, and the sign of what is worse."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=FOLDER)
    parser.add_argument("--out", type=Path, default=Path("docs/results.md"))
    asked = parser.parse_args()
    asked.out.write_text(page(asked.results), encoding="utf-8")
    return 0


def page(folder: Path) -> str:
    """The page of a folder of results."""
    rows = list(all_rows(folder))
    judged = [row for row in rows if row.met is not None]
    missed = sum(not row.met for row in judged)
    out = [HEAD, f"{missed} of {len(judged)} targets are missed; their values are in bold."]
    summary = _read(folder / "summary.json") or {}
    for question in dict.fromkeys([*QUESTIONS, *(row.question for row in rows)]):
        mine = [row for row in rows if row.question == question]
        if not mine:
            continue
        out += [f"\n## {question}", ""]
        out += [f"{note}\n" for note in summary.get("notes", {}).get(question, [])]
        out += ["| what | target | value | command | date |", "|---|---|---|---|---|"]
        out += [row.line() for row in sorted(mine, key=lambda row: row.met is not False)]
        for picture in summary.get("pictures", {}).get(question, []):
            out += ["", f"{picture['caption']}", "", f"![{picture['alt']}]({picture['file']})"]
    return "\n".join(out) + "\n"


def all_rows(folder: Path) -> Iterator[Row]:
    """The rows of all files, in the order of the files below."""
    readers: dict[str, Callable[[Any, str, str], Iterable[Row]]] = {
        "flights": of_flights, "dirty": of_dirty, "halves": of_halves, "accuracy_raster": of_raster,
        "fixes": of_fixes, "worst": of_worst, "paper": of_paper, "house": of_house,
        "reflectance": of_reflectance, "cluster": of_cluster, "light": of_light,
        "marking": of_marking, "incremental": of_incremental,
        "peers": of_peers,
    }  # fmt: skip
    for name, reader in readers.items():
        data = _read(folder / f"{name}.json")
        if data:
            yield from reader(data, *_measured_by(folder / name, data))
    for row in (_read(folder / "summary.json") or {}).get("rows", []):
        known = {key: value for key, value in row.items() if key != "commit"}
        yield Row(**known)


def of_flights(data: Any, command: str, _: str) -> Iterator[Row]:
    flights: dict[str, Any] = data["flights"]
    date = max((flight["date"] for flight in flights.values()), default="")

    def row(what: str, target: str, value: str, met: bool | None) -> Row:
        return Row(FLIGHTS, what, target, value, met, command, date)

    done = {name: flight for name, flight in flights.items() if flight["exit_code"] == 0}
    yield row("real flights that end with a mosaic", "all",
              f"{len(done)} of {len(flights)}", len(done) == len(flights))  # fmt: skip
    short = [name for name, flight in done.items() if flight["tied_share"] < 0.9]
    yield row("flights with nine of ten frames tied", "all",
              _but(len(done) - len(short), len(done), short), not short)  # fmt: skip
    missed = {name: flight["missed"] for name, flight in done.items() if flight["missed"]}
    yield row("flights that meet what is expected of them (`expect` in their sheets)", "all",
              _but(len(done) - len(missed), len(done), missed), not missed)  # fmt: skip
    seams = [f["seams_px"] for f in done.values() if f.get("seams_px") is not None]
    yield row("flights with a median seam mismatch below 1 px", "",
              f"{sum(s < 1.0 for s in seams)} of {len(seams)}", None)  # fmt: skip
    grades = Counter(flight["verdict"] for flight in done.values())
    yield row("verdicts: good, doubtful, bad", "",
              ", ".join(str(grades[g]) for g in ("good", "doubtful", "bad")), None)  # fmt: skip
    ratio = _ratio(done.values())
    if ratio is not None:
        yield row("time of adjustment over matching, flights summed", "0.7", f"{ratio:.2f}", ratio <= 0.7)
    for name in ("sheffield",):
        alone = _ratio([done[name]]) if name in done else None
        if alone is not None:
            yield row(
                f"time of adjustment over matching, {name} (rolling shutter)",
                "1",
                f"{alone:.2f}",
                alone <= 1.0,
            )
    for name, flight in done.items():
        check = flight.get("check") or {}
        if "rmse_horizontal_m" in check and not check.get("after_similarity"):
            up = check.get("rmse_up_m")
            values = f"{check['rmse_horizontal_m']:.3f} m" + ("" if up is None else f", {up:.3f} m")
            yield row(f"{name}: RMSE at {check['n']} check points, plan and height", "", values, None)


def of_dirty(data: Any, command: str, date: str) -> Iterator[Row]:
    rows = data if isinstance(data, list) else data["rows"]

    def share(what: str, target: str, part: int, whole: int, met: bool) -> Row:
        value = f"{part} of {whole} ({100 * part / max(whole, 1):.0f} %)"
        return Row(DIRTY, what, target, value, met, command, date)

    for kind, least, name in (("dirty", 0.96, "unseen surveys with faults"), ("plain", 1.0, "plain surveys")):
        mine = [r for r in rows if r["kind"] == kind]
        if not mine:
            continue
        right = [r for r in mine if r["outcome"].startswith("right")]
        yield share(f"{name}: right", f"{100 * least:.0f} %", len(right), len(mine),
                    len(right) >= least * len(mine))  # fmt: skip
        wrong = [r for r in mine if r["outcome"] == "wrong, not flagged"]
        yield share(f"{name}: wrong and called good", "none", len(wrong), len(mine), not wrong)
        good = [r for r in right if r["grade"] == "good"]
        yield share(f"{name}: right ones called good", "90 %", len(good), len(right),
                    len(good) >= 0.9 * len(right))  # fmt: skip
        none = [r for r in mine if r["outcome"] == "no mosaic"]
        yield share(f"{name}: no mosaic", "none", len(none), len(mine), not none)
    in_90 = interval_of(0.9)
    for what, off, key, part, times in (
        ("places within the stated CE90", "map_absolute_m", "rmse_h_m", "absolute", circle_of(0.9)),
        ("distances over 100 m within the stated 90 %", "over_100_m", "rmse_m_per_100m", "relative", in_90),
        ("distances over the map within the stated 90 %", "over_whole_m", "rmse_m_whole", "relative", in_90),
        ("scale within the stated 90 %", "scale_off_permille", "scale_permille", "relative", in_90),
    ):  # fmt: skip
        pairs = [
            (r.get(off), ((r.get("accuracy") or {}).get(part) or {}).get(key))
            for r in rows
            if r["kind"] == "dirty"
        ]
        within = [abs(o) <= times * sd for o, sd in pairs if o is not None and sd is not None]
        if within:
            found = sum(within)
            yield Row(STATED, f"surveys with faults: {what}", "85 to 95 %",
                      f"{found} of {len(within)} ({100 * found / len(within):.0f} %)",
                      0.85 <= found / len(within) <= 0.95, command, date)  # fmt: skip


def of_halves(data: Any, command: str, date: str) -> Iterator[Row]:
    for name, half in data["flights"].items():
        shares = [half.get(key) or 0.0 for key in ("within", "within_100_m", "within_whole")]
        what = f"split halves of {name}: places, 100 m, whole map within the stated 90 %"
        values = ", ".join(f"{100 * share:.0f} %" for share in shares)
        yield Row(STATED, what, "90 % each", values, min(shares) >= 0.9, command, date)


def of_raster(data: Any, command: str, date: str) -> Iterator[Row]:
    for row in data["pooled"]:
        if row["survey"] != "all" or row["positions"] == "all":
            continue
        found = [row[key] for key in ("plan", "up") if row.get(key) is not None]
        what = f"`accuracy.tif`, {row['positions']}, {row['class']}: true over stated error, plan and height"
        met = all(0.8 <= f <= 1.25 for f in found)
        yield Row(STATED, what, "0.8 to 1.25", ", ".join(f"{f:.2f}" for f in found), met, command, date)


def of_fixes(data: Any, command: str, date: str) -> Iterator[Row]:
    right, cases = sum(bool(row["right"]) for row in data["rows"]), len(data["rows"])
    what = "fixes that the verdict names: the figure is good after the fix"
    yield Row(STATED, what, "all", f"{right} of {cases}", right == cases, command, date)


def of_reflectance(data: Any, command: str, date: str) -> Iterator[Row]:
    for row in data["rows"]:
        what = f"{row['case']}: 99 % of the {row['of']} lie within"
        yield Row(REFLECTED, what, "0.02", f"{row['q99']:.4f}", bool(row["right"]), command, date)


def of_cluster(data: Any, command: str, date: str) -> Iterator[Row]:
    there = data["rows"][1:]  # the first is the machine they are compared with
    other = [row["case"] for row in there if not row["same"]]
    what = "Dask without a shared disk: runs with the bytes of one machine"
    value = _but(len(there) - len(other), len(there), other)
    yield Row(SAFE, what, "all", value, not other, command, date)
    for stage, ratio in data["two_over_one"].items():
        if stage != "seconds":
            what = f"{stage} by two Dask workers without a shared disk: speed over one"
            yield Row(FAST, what, "1.7", f"{ratio:.2f}", ratio >= 1.7, command, date)


def of_incremental(data: Any, _command: str, _date: str) -> Iterator[Row]:
    wanted = data["targets"]
    for row in data["rows"]:
        command, date = row["command"], row["date"]
        counts = f"{row['frames_added']} frames added to {row['frames_before']}"
        of = f"{counts} by --incremental, {row['positions']}"
        for name, what, into in (
            ("share_of_time", "share of a whole run's time", FAST),
            ("shift_px", "shift against a whole run's mosaic, 95 %, px", SAFE),
            ("grey", "mean difference against a whole run's mosaic, grey levels", SAFE),
        ):
            value, most = row[name], wanted[name]
            yield Row(into, f"{of}: {what}", f"{most:g}", f"{value:.3f}", value <= most, command, date)


def of_light(data: Any, command: str, date: str) -> Iterator[Row]:
    for case in data["cases"]:
        judged = case["way"] == "one exposure"
        of = f"simulated flights with {case['kind']} ({case['flights']} in all), {case['way']}"
        for name, what, target in (
            ("radiance", "mosaic against the true radiance, RMS, median; worst", 0.02),
            ("hot_spot", "hot spot left in the mosaic, median; worst", 0.01),
        ):
            worst = case[f"{name}_worst"]
            value = f"{100.0 * case[f'{name}_median']:.1f} %; {100.0 * worst:.1f} %"
            met = worst <= target if judged else None
            yield Row(LOOKS, f"{of}: {what}", f"{100.0 * target:.0f} %" if judged else "-", value,
                      met, command, date)  # fmt: skip


def of_worst(data: Any, command: str, date: str) -> Iterator[Row]:
    for fault in data["faults"]:
        right, simulated = fault["right"], fault["simulated"]
        yield Row(FAULTS, f"`{fault['fault']}` named right; named where there is none",
                  "all; none", f"{right} of {simulated}; {fault['false']}",
                  right == simulated and not fault["false"], command, date)  # fmt: skip
    for called in data["called"]:
        if called["faults"] and called["called"] == "sure":
            share = called["right"] / called["faults"]
            yield Row(FAULTS, "causes called sure that are right", "99 %",
                      f"{called['right']} of {called['faults']}", share >= 0.99, command, date)  # fmt: skip


def of_paper(data: Any, command: str, date: str) -> Iterator[Row]:
    methods = ("none", "chain", "layered", "base_frame", "error_sharing", "least_squares", "bundle")
    for case in data["cases"].values():
        there = [case["methods"].get(method) for method in methods]
        if None in there:
            continue
        values = ", ".join(f"{found['frame_rms_m']:.2f}" for found in there)
        yield Row(PAPER, f"{case['title']}: position error, m", "", values, None, command, date)
        if "line" in case["title"]:
            bundle = case["methods"]["bundle"]
            slope, sd = 1000 * bundle["slope_m_per_frame"], 1000 * bundle["slope_sd_m_per_frame"]
            what = f"{case['title']}: growth of the error along the line, bundle"
            met = abs(slope) <= SIGNIFICANT * sd
            yield Row(PAPER, what, "0 mm a frame", f"{slope:+.0f} ± {sd:.0f} mm", met, command, date)


def of_peers(data: Any, _: str, __: str) -> Iterator[Row]:
    for name, flight in data["flights"].items():
        command, date = flight["command"], flight["date"]
        ours, *peers = flight["programs"]
        for peer in peers:
            figures = peer["figures"]
            if peer["failed"] or "processor_s" not in figures:
                yield Row(FAST, f"{name}: {peer['name']}", "", peer["failed"], None, command, date)
                continue
            mine = ours["figures"]
            shown = [of for of in _COMPARED if of[0] in figures and of[0] in mine]
            theirs, own = (
                ", ".join(f"{of[key]:.3g}{unit}" for key, unit, _ in shown) for of in (figures, mine)
            )
            met = all(sign * mine[key] <= sign * figures[key] for key, _, sign in shown)
            what = f"{name}: {peer['name']}: processor time, error of centres or SSIM"
            yield Row(FAST, what, f"geomosaic better: {own}", theirs, met, command, date)


def of_marking(data: Any, command: str, date: str) -> Iterator[Row]:
    what = f"{data['targets']} targets of {data['frames']} frames marked in the browser by a scripted person"
    page, off = f"{data['page_s']:.0f} s of them the page", f"at most {data['most_off_px']:.2f} px off"
    value = f"{data['seconds']:.0f} s, {page}; {data['marks']} marks, {off}"
    yield Row(GIS, what, f"{data['most_s']:.0f} s, 1 px", value, data["right"], command, date)


def of_house(data: Any, command: str, date: str) -> Iterator[Row]:
    targets = {
        "lines": ("lines of `geomosaic/`, the simulator apart (72,579 with it when counted first)", 60_000),
        "lines_of_adjustment_and_estimation": ("lines of `adjustment/` with `estimation/`", 7_000),
        "constants": ("constants with a record (`python -m geomosaic.constants`; 840 at first)", 400),
        "lines_of_constants": ("lines of these records (7,069 at first)", 1_500),
        "of_them_in_adjustment": ("signatures of the adjustment with more than five arguments", 0),
        "signatures_over_5_arguments": ("signatures with more than five arguments", 0),
    }
    for key, (what, most) in targets.items():
        yield Row(HOUSE, what, f"{most:,}", f"{data[key]:,}", data[key] <= most, command, date)
    long_modules = data["modules_over_300_lines"]
    yield Row(HOUSE, "modules with more than 300 lines", "none", str(len(long_modules)), not long_modules,
              command, date)  # fmt: skip
    rooms = f"{data['rooms']} rooms, {data['arrows']} arrows"
    yield Row(HOUSE, "rooms and imports between them", "", rooms, None, command, date)
    longest = data["longest_function"]
    yield Row(
        HOUSE, "longest function", "", f"{longest['lines']} lines, {longest['where']}", None, command, date
    )


def _ratio(flights: Iterable[Any]) -> float | None:
    times = [(f["stages_s"].get("adjustment.solve"), f["stages_s"].get("matching.sift")) for f in flights]
    both = [(solve, match) for solve, match in times if solve is not None and match]
    return sum(solve for solve, _ in both) / sum(match for _, match in both) if both else None


def _but(part: int, whole: int, names: Iterable[str]) -> str:
    return f"{part} of {whole}" + (f", not {', '.join(names)}" if part < whole else "")


def _measured_by(stem: Path, data: Any) -> tuple[str, str]:
    """Command and date of the JSON, else the first ones in the head of its Markdown."""
    if isinstance(data, dict):
        return data["command"].partition(" --results")[0], data.get("date", "")
    head = (
        stem.with_suffix(".md").read_text(encoding="utf-8")[:1000] if stem.with_suffix(".md").exists() else ""
    )
    command = re.search(r"`((?:make|tools/)[^`]*)`", head)
    date = re.search(r"\d{4}-\d\d-\d\d", head)
    return command[1] if command else f"make bench-{stem.name}", date[0] if date else ""


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


if __name__ == "__main__":
    raise SystemExit(main())
