"""The kinds of trials: which file is spoiled how, and by which commands it then comes in."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from random import Random

from tools.fuzz.fuzz_base import MAP_CRS
from tools.fuzz.fuzz_formats import (
    artefact_parts,
    exif_tags,
    jpeg_entropy,
    jpeg_segments,
    mostly,
    png_chunks,
    tiff_tags,
    xmp_packet,
)
from tools.fuzz.fuzz_mutations import Mutate, Nasty, a_table, some_bytes, some_text, spoil_the_file
from tools.fuzz.fuzz_recordings import a_recording
from tools.fuzz.fuzz_trees import a_json, a_yaml, an_xml
from tools.trials.trial_box import MEMORY_BYTES

HANG_S = 60.0
FILE_SHARE = 0.05
"""Share of the cases in which something else stands in the file's place: a link, a pipe, a folder."""
WHOLE_SHARE = 0.05
"""Share of a survey's cases that go through the whole mosaic."""

_RASTER = (
    "<VRTDataset rasterXSize='40' rasterYSize='40'>"
    "<VRTRasterBand dataType='Byte' band='1'><SimpleSource>"
    "<SourceFilename>{0}</SourceFilename></SimpleSource>"
    "</VRTRasterBand></VRTDataset>"
)
Commands = Sequence[Sequence[str]]


@dataclass(frozen=True)
class Kind:
    """A room's door: `files` (patterns in the box) are spoiled by `how`, then `commands` run.

    judge: what is compared with the unspoiled result: `survey` (positions, cameras, ground), `pixels`
    (the mosaic too), `same` (everything must be as it was), or nothing.
    template: what the box is filled with before. weight: the share of all cases.
    each: the commands don't build on one another: all run, whatever the others end with.
    most_s, most_bytes: what one command may take.
    """

    name: str
    weight: int
    template: str
    files: tuple[str, ...]
    how: Callable[[str], Mutate]
    commands: Callable[[Path, str, Random], Commands]
    judge: str = "survey"
    each: bool = False
    most_s: float = HANG_S
    most_bytes: int = MEMORY_BYTES


def _run(box: Path, recipe: str, *sets: str) -> list[str]:
    words = ["run", str(box / "in" / recipe), "-o", str(box / "out"), "--workers", "1", "--fixed-time"]
    return [*words, *(word for one in sets for word in ("--set", one))]


def _survey(box: Path, rng: Random, recipe: str = "short.yaml", **files: str) -> Commands:
    """Reads the survey with these files; now and then through the whole mosaic."""
    if recipe == "short.yaml" and rng.random() < WHOLE_SHARE:
        recipe = "whole.yaml"
    given = {"pos": "pos.csv", "camera": "cameras.json"} | files
    sets = [f"survey.read.{name}={box / 'in' / file}" for name, file in given.items() if file]
    sets.append(f"survey.read.frames={box / 'in' / 'frames'}")
    if given["pos"] == "opk.csv":
        sets.append(f"survey.read.pos_crs={MAP_CRS}")
    return [_run(box, recipe, *sets)]


def _pos(box: Path, file: str, rng: Random) -> Commands:
    return _survey(box, rng, pos=Path(file).name)


def _camera(box: Path, file: str, rng: Random) -> Commands:
    return _survey(box, rng, camera=Path(file).name)


def _control(box: Path, file: str, rng: Random) -> Commands:
    return _survey(box, rng, gcp=Path(file).name)


def _elevation(box: Path, file: str, rng: Random) -> Commands:
    dem = {"dem.prj": "dem.asc", "dem.asc.aux.xml": "dem.asc"}.get(Path(file).name, Path(file).name)
    return _survey(box, rng, dem=dem)


def _recipe(box: Path, file: str, rng: Random) -> Commands:
    frames = f"survey.read.frames={box / 'in' / 'frames'}"
    if "strips" in file:
        return [_run(box, Path(file).name, f"survey.strips.geometry={box / 'in' / 'geometry.yaml'}")]
    sets = [frames]
    if rng.random() < 0.3:
        stage = rng.choice(("survey.read.crs", "projection.ground.height_m", "placement.pos.neighbours"))
        sets.append(f"{stage}={Nasty(box, 1).word(rng).decode(errors='replace')[:300]}".replace("\0", "0"))
    return [_run(box, Path(file).name, *sets)]


def _tags(box: Path, file: str, rng: Random) -> Commands:
    return _survey(box, rng, pos="", camera="cameras.json" if rng.random() < 0.3 else "")


def _pixels(box: Path, file: str, rng: Random) -> Commands:
    recipe = "pixels.yaml" if rng.random() < 0.6 else "short.yaml"
    return _survey(box, rng, recipe)


def _masked(box: Path, file: str, rng: Random) -> Commands:
    for mask in (box / "in" / "masks").iterdir():
        mask.rename(box / "in" / "frames" / mask.name)
    return _survey(box, rng, "pixels.yaml")


def _strips(box: Path, file: str, rng: Random) -> Commands:
    whole = file.endswith(".tif") or rng.random() < 2 * WHOLE_SHARE
    recipe = "strips_whole.yaml" if whole else "strips.yaml"
    return [_run(box, recipe, f"survey.strips.geometry={box / 'in' / 'geometry.yaml'}")]


def _recording(box: Path, file: str, rng: Random) -> Commands:
    recording, out = str(box / file), str(box / "out")
    frame, other = rng.sample(sorted(p.name for p in (box / "in" / "frames").iterdir() if p.is_file()), 2)
    asked: Commands = (
        [],
        ["--json"],
        ["--worst", "9", "--stage", "placement.pos", "--json"],
        ["--worst", "9", "--png", f"{out}/plan.png"],
        ["--frame", frame, "--png", f"{out}/frame.png"],
        ["--pair", frame, other, "--png", f"{out}/pair.png"],
        ["--repair", f"{out}/whole.mcap"],
    )
    both = [recording, str(box / "in" / "other.mcap")]
    compared: Commands = (both, [*both[::-1], "--json"], [*both, "--png", f"{out}/moved.png"])
    replayed: Commands = (
        ["--from", "placement.pos", "--until", "matching.sift"],
        ["--from", "export.cog", "--frames", str(box / "in" / "frames")],
        ["--from", "placement.pos"],
        ["--from", "export.cog"],
        ["--from", "export.report"],
        ["--set", "export.cog.quality=80"],
    )
    again = ["replay", recording, "-o", f"{out}/again", "--workers", "1", "--fixed-time"]
    return [
        ["inspect", recording, *rng.choice(asked)],
        ["diff", *rng.choice(compared)],
        ["view", recording, "--save", f"{out}/run.rrd"],
        [*again, *rng.choice(replayed)],
    ]


def _again(box: Path, file: str, rng: Random) -> Commands:
    return _survey(box, Random(0), "pixels.yaml")


def _finished(box: Path, file: str, rng: Random) -> Commands:
    out = str(box / "out")
    export = rng.choice(("vrt", "tiles", "stac"))
    reference = str(box / "in" / "ortho.tif")
    return rng.choice(
        (
            [["export", export, out]],
            [["evaluate", out, "--reference", reference, "--json"]],
            [["inspect", out]],
            [*_again(box, file, rng)],
            [*_again(box, file, rng), ["export", "vrt", out]],
        )
    )


def _by_name(file: str) -> Mutate:
    """The structure that a file's name speaks of."""
    name = Path(file).name
    structures: dict[str, Mutate] = {
        ".json": a_json, ".yaml": a_yaml, ".csv": a_table, ".txt": a_table, ".TXT": some_text, ".vrt": an_xml,
        ".asc": a_table, ".prj": some_text, ".xml": an_xml, ".html": some_text,
        ".tif": mostly(tiff_tags), ".png": mostly(png_chunks), ".mcap": mostly(a_recording),
        ".artefact": mostly(artefact_parts), ".gpkg": some_bytes,
    }  # fmt: skip
    return structures.get(Path(name).suffix, some_bytes)


KINDS = {
    kind.name: kind
    for kind in (
        Kind("pos", 12, "survey", ("in/pos.csv", "in/geo.txt", "in/pix4d.csv", "in/opk.csv"), _by_name, _pos),
        Kind(
            "camera",
            8,
            "survey",
            ("in/cameras.json", "in/camera.yaml", "in/orthority.yaml"),
            _by_name,
            _camera,
        ),
        Kind("recipe", 8, "survey", ("in/short.yaml",), _by_name, _recipe, ""),
        Kind("control", 6, "survey", ("in/gcp_list.txt", "in/gcp.csv"), _by_name, _control),
        Kind(
            "dem",
            10,
            "survey",
            ("in/dem.tif", "in/dem.asc", "in/dem.vrt", "in/dem.prj"),
            _by_name,
            _elevation,
        ),
        Kind("exif", 10, "survey", ("in/frames/F000*.jpg",), lambda _: mostly(exif_tags, 0.95), _tags),
        Kind("xmp", 8, "survey", ("in/frames/F000*.jpg",), lambda _: mostly(xmp_packet, 0.95), _tags),
        Kind(
            "jpeg",
            8,
            "survey",
            ("in/frames/F000*.jpg",),
            lambda _: mostly(jpeg_segments, 0.85),
            _pixels,
            "pixels",
        ),
        Kind(
            "entropy",
            5,
            "survey",
            ("in/frames/F000*.jpg",),
            lambda _: mostly(jpeg_entropy, 1.0),
            _pixels,
            "pixels",
        ),
        Kind("tiff", 8, "tiffs", ("in/frames/F000*.tif",), _by_name, _pixels, "pixels"),
        Kind("mask", 5, "survey", ("in/masks/*",), _by_name, _masked, "pixels"),
        Kind("geometry", 8, "strips", ("in/geometry.yaml",), _by_name, _strips, "strips"),
        Kind("model", 8, "strips", ("in/model*", "in/*RPC.TXT", "in/dem.tif"), _by_name, _strips, "strips"),
        Kind("strip", 3, "strips", ("in/ccd*.tif",), _by_name, _strips, "strips"),
        Kind(
            "recording",
            10,
            "recorded",
            ("in/rec/run.mcap",),
            _by_name,
            _recording,
            "",
            each=True,
            most_s=20.0,
            most_bytes=1 << 30,
        ),
        Kind("cache", 10, "run", ("out/work/**/*",), _by_name, _again, "same"),
        Kind("forged", 6, "run", ("out/work/*/*/*.artefact", "out/work/*/*.tif"), _by_name, _again, ""),
        Kind("run", 8, "run", ("out/*",), _by_name, _finished, ""),
    )
}


def _forge(box: Path, name: str, old: bytes, new: bytes) -> None:
    """Puts the spoiled file's hash into the cache's entry, as a stranger who knows the format would."""
    marks = [blake2b(data, digest_size=20).hexdigest().encode() for data in (old, new)]
    for entry in (box / "out" / "work").glob("*/*/entry.json"):
        entry.write_bytes(entry.read_bytes().replace(*marks))


def spoil(kind: Kind, box: Path, rng: Random, nasty: Nasty) -> tuple[str, str]:
    """Spoils one file of the box: its name in the box, and what was done."""
    found = sorted(
        p for pattern in kind.files for p in box.glob(pattern) if p.is_file() and not p.is_symlink()
    )
    path = rng.choice(found)
    name = path.relative_to(box).as_posix()
    if rng.random() < FILE_SHARE:
        return name, spoil_the_file(path, rng, nasty)
    data, done = path.read_bytes(), []
    old = data
    mutate = kind.how(name)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data, what = mutate(data, rng, nasty)
        done.append(what)
    if kind.name == "forged":
        if path.suffix == ".tif" and rng.random() < 0.5:
            data, done = _RASTER.format(box / "outside" / "secret.tif").encode(), ["a VRT of people's file"]
        _forge(box, name, old, data)
    path.write_bytes(data)
    return name, ", then ".join(done)


def fill(box: Path, template: Path) -> None:
    """Puts a template's folders into the box."""
    for part in template.iterdir():
        shutil.copytree(part, box / part.name, dirs_exist_ok=True, symlinks=True)
