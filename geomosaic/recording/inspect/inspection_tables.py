"""Answers of an `Inspection` as text for people."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from geomosaic.recording.inspect.tables import bytes_of, line, new_table, number, row, share, shortened

_MOST_LOG = 40


def show_head(head: dict[str, Any], console: Console) -> None:
    """The file, whether it is whole, and how the run ended."""
    state = "whole" if head["whole"] else f"not whole: {head['problem']}"
    line(console, f"{head['path']}: {state}")
    if head["unreadable"]:
        line(console, f"its frames can't be read: {head['unreadable']}")
    ended = head["ended"]
    if not ended["finished"]:
        line(console, f"the run ended {ended['text']}")
        if ended.get("memory_mb"):
            line(console, f"  memory then: {ended['memory_mb']:.0f} MB")
        for words in ended.get("last_words", ()):
            line(console, f"  last words: {words}")


def show_faults(worst: dict[str, Any], console: Console) -> None:
    """What is wrong, how sure that is, how to fix it."""
    shown, found = len(worst["faults"]), worst["faults_found"]
    if not found:
        line(console, "nothing is known to be wrong")
        return
    line(console, f"what is wrong, worst first{f' ({shown} of {found})' if shown < found else ''}:")
    for fault in worst["faults"]:
        whose = f"{', '.join(fault['frames'])}: " if fault["frames"] and len(fault["frames"]) < 4 else ""
        line(console, f"  {fault['code']}: {whose}{fault['text']}")
        line(console, f"    how sure: {fault['sure']}")
        line(console, f"    fix: {fault['fix']}")


def show_worst(worst: dict[str, Any], console: Console) -> None:
    """The faults, and the worst frames and pairs."""
    show_faults(worst, console)
    if worst["frames"]:
        counts = ", ".join(f"{n} {status}" for status, n in worst["frames_by_status"].items())
        table = new_table(
            f"frames ({counts}), those moved most first",
            *("frame", "status", "moved east, north, up, m", "yaw off, deg", "ties", "left, px"),
            "down-weighted",
        )
        for f in worst["frames"]:
            row(table, *_frame_cells(f))
        console.print(table)
    if worst["pairs_tied"] or worst["pairs_untied"]:
        title = f"pairs ({worst['pairs_tied']} tied, {worst['pairs_untied']} not)"
        _show_pairs(title, [*worst["pairs"], *worst["untied"]], console)


def show_frame(frame: dict[str, Any], console: Console) -> None:
    """A frame: given and found pose, what ties it, what was said of it."""
    line(console, f"{frame['frame']}: {frame['status']}")
    for said in frame["said"]:
        line(console, f"  {said}")
    if frame["status"] == "left_out":
        return
    for fault in frame["faults"]:
        line(console, f"  how sure ({fault['code']}): {fault['sure']}; fix: {fault['fix']}")
    given, found = frame["given"] or {}, frame["found"] or {}
    if given:
        table = new_table("pose", "", "given", "found", "sd given", "sd found")
        for name, sd, digits in _POSE:
            values = (number(given.get(name), digits), number(found.get(name), digits))
            row(table, name, *values, number(given.get(sd), 3), number(found.get(sd), 3))
        console.print(table)
    east, north, up = (number(v, 2) for v in frame["moved_m"])
    turn = number(frame["yaw_off_deg"], 2)
    line(console, f"found minus given: {east} m east, {north} m north, {up} m up; yaw {turn} degrees")
    if frame["image_turned_deg"]:
        line(console, f"its image was turned by {frame['image_turned_deg']} degrees; this is corrected")
    line(
        console,
        f"flight line {frame['line']}; {frame['pairs_tied']} pairs tied, {frame['pairs_untied']} not; "
        f"{frame['tie_points']} tie points, {number(frame['rms_m'])} m left on the ground, "
        f"{number(frame['rms_px'])} px in the image, {share(frame['share_down_weighted'])} down-weighted",
    )
    _show_pairs("its pairs", frame["pairs"], console)
    _show_log(frame["log"], console)


def show_pair(pair: dict[str, Any], console: Console) -> None:
    """A pair: whether it is tied, by what, and what is left; or why not."""
    _show_pairs("pair", [pair], console)
    if pair["tied"]:
        east, north = (number(v, 3) for v in pair["mean_m"])
        line(console, f"misalignment, right minus left: {east} m east, {north} m north")
        names = {"median": "median_m", "90 %": "p90_m", "99 %": "p99_m", "largest": "max_m"}
        spread = ", ".join(f"{what} {number(pair.get(name))} m" for what, name in names.items())
        line(console, f"residuals: {spread}")
        if pair.get("down_weighted") is not None:
            seen = f"{pair['in_solve']} of {pair['tie_points']}"
            line(console, f"{seen} in the solve, {pair['down_weighted']} of them down-weighted")


def show_stage(stage: dict[str, Any], console: Console) -> None:
    """A stage: what it was given, made and said."""
    done = "from the cache" if stage["cached"] else "done" if stage["finished"] else "unfinished"
    seconds = "" if stage["seconds"] is None else f" in {stage['seconds']:.2f} s"
    line(console, f"{stage['id']}, version {stage['version']}: {done}{seconds}")
    for title, kind in (("parameters", "params"), ("inputs", "inputs"), ("files", "written")):
        for name, value in stage[kind].items():
            line(console, f"  {title}: {name} = {shortened(value)}")
    for name, output in stage["outputs"].items():
        line(console, f"  output: {name} {output['fingerprint'][:12]}, {bytes_of(output['bytes'])}")
    for name, value in _flat("", stage["metrics"]):
        line(console, f"  {name} = {shortened(value)}")
    if stage["iterations"]:
        columns = ("step", "solve", "cost", "sigma, px", "damping", "largest move, m", "down-weighted")
        table = new_table("steps of the solve", *columns)
        for i in stage["iterations"]:
            cells = (number(i[k]) for k in ("cost", "sigma_px", "damping", "step_m"))
            row(table, i["iteration"], i["solve"], *cells, share(i["share_down_weighted"]))
        console.print(table)
    _show_log(stage["log"], console)


_POSE = (
    ("lon_deg", "", 8),
    ("lat_deg", "", 8),
    ("easting_m", "sd_e_m", 2),
    ("northing_m", "sd_n_m", 2),
    ("height_ellipsoidal_m", "sd_u_m", 2),
    ("yaw_deg", "sd_kappa_deg", 2),
    ("pitch_deg", "sd_phi_deg", 2),
    ("roll_deg", "sd_omega_deg", 2),
)


def _frame_cells(f: dict[str, Any]) -> list[Any]:
    if "moved_m" not in f:
        return [f["frame"], f["status"], *[""] * 5]
    moved = ", ".join(number(v, 1) for v in f["moved_m"])
    figures = (number(f["yaw_off_deg"], 1), f["tie_points"], number(f["rms_px"]))
    return [f["frame"], f["status"], moved, *figures, share(f["share_down_weighted"])]


def _show_pairs(title: str, pairs: list[dict[str, Any]], console: Console) -> None:
    if not pairs:
        return
    table = new_table(
        title, "left", "right", "ties", "apart on the ground, px", "largest, m", "down-weighted", ""
    )
    for p in pairs:
        if p["tied"]:
            figures = (number(p["rms_px"]), number(p["max_m"]), share(p["share_down_weighted"]), "")
            row(table, p["left"], p["right"], p["tie_points"], *figures)
        else:
            row(table, p["left"], p["right"], "", "", "", "", f"not tied: {p['why_not']}")
    console.print(table)


def _show_log(log: list[dict[str, Any]], console: Console) -> None:
    if len(log) > _MOST_LOG:
        line(console, f"the last {_MOST_LOG} of {len(log)} lines of the log:")
    for said in log[-_MOST_LOG:]:
        about = f"{said['frame']}: " if said["frame"] else ""
        line(console, f"  {said['level']}: {about}{said['text']}")


def _flat(name: str, value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        return [pair for k, v in value.items() for pair in _flat(f"{name}.{k}" if name else str(k), v)]
    return [(name, value)]
