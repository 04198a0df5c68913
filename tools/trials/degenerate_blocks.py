"""Blocks that no survey should have, drawn at random: what the adjustment must survive."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.model import Block, GroundControl, Settings
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.projection.ground import GroundSurface

FLIGHTS = ("grid", "line", "one place", "two at one place", "two parts", "stacked", "below ground")
LOOKS = ("nadir", "horizon", "past the horizon", "upwards", "any", "one at the horizon")
TIES = (
    "good",
    "good",
    "noisy",
    "wrong",
    "far points",
    "one a pair",
    "few",
    "same place",
    "on a line",
    "none",
    "not finite",
)
DEVIATIONS = ("usual", "usual", "zero", "tiny", "huge", "not finite", "unknown positions")
CONTROL = (
    "none",
    "none",
    "good",
    "seen once",
    "parallel rays",
    "absurd",
    "same place",
    "not finite",
    "two only",
)
LENSES = ("usual", "usual", "short", "long", "fisheye", "two cameras", "rolling", "wild distortion")
SIZE_PX = (640, 480)


@dataclass(frozen=True)
class Draw:
    """A degenerate block with the settings to adjust it by, and what it was made of."""

    block: Block
    settings: Settings
    kind: str


def draw(seed: int) -> Draw:
    """The block of a seed: 1 to 7 frames of 640 x 480 px over land at zero."""
    rng = np.random.default_rng(seed)
    flight, look, ties, sd, control, lens = (
        str(rng.choice(kinds)) for kinds in (FLIGHTS, LOOKS, TIES, DEVIATIONS, CONTROL, LENSES)
    )
    n = int(rng.integers(1, 8))
    cameras = _cameras(lens, n, rng)
    truth = _poses(flight, look, n, rng)
    given = _given(truth, sd, lens, rng)
    up_m = rng.choice([0.0, 0.0, 0.0, 150.0]) + np.zeros((3, 3))
    ground = GroundSurface(str(rng.choice(["flat", "dem"])), -500.0, -500.0, 500.0, up_m)
    block = Block(
        names=tuple(f"F{i}" for i in range(n)),
        cameras=cameras,
        poses=given,
        ground=ground,
        ties=TiePoints(_pairs(ties, truth, cameras, rng)),
        sequence=tuple(range(n)),
        lines=(0,) * n,
        ground_pixel_m=0.2,
        turned=tuple(int(q) for q in rng.choice([0, 2], n)) if rng.random() < 0.1 else (),
        control=_control(control, truth, cameras, rng),
        times_s=np.arange(n) * float(rng.choice([0.0, 2.0])),
    )
    switches = ("boresight", "lever_arm", "gps_lag", "rolling_shutter", "turning")
    asked = {name: bool(rng.random() < 0.1) for name in switches}
    ground_kind = str(rng.choice(["auto", "auto", "flat", "tie_surface"]))
    model = str(rng.choice(["auto", "given"]))
    settings = Settings(ground=ground_kind, model=model, **asked)
    return Draw(
        block, settings, f"{n} frames, {flight}, {look}, ties {ties}, sd {sd}, control {control}, {lens}"
    )


def _cameras(lens: str, n: int, rng: np.random.Generator) -> tuple[Camera, ...]:
    width, height = SIZE_PX
    focal = {"short": 60.0, "long": 20000.0}.get(lens, 500.0)
    camera = Camera("one", width, height, focal, width / 2.0, height / 2.0, focal_length_sd_px=0.02 * focal)
    if lens == "fisheye":
        camera = replace(camera, kind="fisheye", focal_length_px=300.0)
    if lens == "rolling":
        camera = replace(camera, readout_s=0.05, readout_sd_s=float(rng.choice([0.0, 0.01])))
    if lens == "wild distortion":
        camera = replace(camera, k1=float(rng.choice([-2.0, 5.0])), k2=-3.0, p1=0.2)
    other = replace(camera, name="two", focal_length_px=0.5 * focal)
    return tuple(other if lens == "two cameras" and i % 2 else camera for i in range(n))


def _poses(flight: str, look: str, n: int, rng: np.random.Generator) -> Poses:
    i = np.arange(n)
    at = np.column_stack([40.0 * (i // 3), 25.0 * (i % 3), np.full(n, 100.0)]).astype(np.float64)
    if flight == "line":
        at = np.column_stack([np.zeros(n), 25.0 * i, np.full(n, 100.0)])
    if flight in ("one place", "stacked"):
        at[:] = [0.0, 0.0, 100.0]
    if flight == "stacked":
        at[:, 2] += 30.0 * i
    if flight == "two at one place" and n > 1:
        at[1] = at[0]
    if flight == "two parts":
        at[n // 2 :, 0] += 5000.0
    if flight == "below ground":
        at[:, 2] = rng.choice([-5.0, 0.0, 1e-3])
    at += rng.normal(0.0, float(rng.choice([0.0, 0.5])), (n, 3)) * (flight not in ("one place",))
    pitch = {"horizon": 85.0, "past the horizon": 100.0, "upwards": 180.0}.get(look, 0.0)
    tilt = np.full(n, np.radians(pitch))
    if look == "any":
        tilt = rng.uniform(0.0, np.pi, n)
    if look == "one at the horizon":
        tilt[0] = np.radians(88.0)
    yaw = rng.choice([0.0, 1.0]) * rng.uniform(-np.pi, np.pi, n)
    rotations = Rotation.from_yaw_pitch_roll(yaw, tilt, rng.normal(0.0, 0.01, n)).matrix
    return Poses(at, rotations, np.full((n, 3), 1.0), np.full((n, 3), 0.02))


def _given(truth: Poses, sd: str, lens: str, rng: np.random.Generator) -> Poses:
    n = len(truth.positions_m)
    position_sd, turn_sd = np.full((n, 3), 1.5), np.tile(np.radians([1.0, 1.0, 5.0]), (n, 1))
    at = truth.positions_m + rng.normal(0.0, 1.5, (n, 3))
    rotations = truth.rotations
    if sd in ("zero", "tiny", "huge"):
        value = {"zero": 0.0, "tiny": 1e-12, "huge": 1e12}[sd]
        position_sd, turn_sd = np.full((n, 3), value), np.full((n, 3), value)
    if sd == "not finite":
        position_sd[rng.integers(n)] = rng.choice([np.nan, np.inf])
        turn_sd[rng.integers(n)] = rng.choice([np.nan, np.inf])
        at[rng.integers(n)] = rng.choice([np.nan, 0.0])
        rotations = rotations.copy()
        rotations[rng.integers(n)] = rng.choice([np.nan, 1.0])
    if sd == "unknown positions":
        some = rng.random(n) < 0.7
        position_sd[some] = 1e5
        at[some] = [0.0, 0.0, 100.0]
    velocities = np.tile([0.0, 10.0, 0.0], (n, 1)) if lens == "rolling" or rng.random() < 0.1 else None
    return Poses(at, rotations, position_sd, turn_sd, velocities)


def _pairs(
    ties: str, truth: Poses, cameras: tuple[Camera, ...], rng: np.random.Generator
) -> tuple[TiePair, ...]:
    n, count = len(cameras), int(rng.integers(20, 90))
    middle = truth.positions_m[:, :2].mean(axis=0)
    at = np.column_stack([middle + rng.uniform(-90.0, 90.0, (count, 2)), rng.normal(0.0, 1.0, count)])
    if ties == "far points":
        at[:, :2] *= 1e6
    if ties == "same place":
        at[:] = at[0]
    if ties == "on a line":
        at[:, 0] = at[0, 0]
    seen = [truth[i].image_from_ground(cameras[i], at) for i in range(n)]
    noise = {"noisy": 8.0, "good": 0.3}.get(ties, 0.3)
    out = []
    for a in range(n):
        for b in range(a + 1, n):
            left, right = (seen[i] + rng.normal(0.0, noise, (count, 2)) for i in (a, b))
            if ties == "wrong":
                left, right = (rng.uniform(0.0, SIZE_PX, (count, 2)) for _ in "ab")
            good = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
            if ties != "far points" and rng.random() < 0.8:
                good &= ((left > 0.0) & (left < SIZE_PX) & (right > 0.0) & (right < SIZE_PX)).all(axis=1)
            number = np.flatnonzero(good).astype(np.int32)
            number = number[: {"one a pair": 1, "few": 4, "none": 0}.get(ties, count)]
            if ties == "not finite" and len(number):
                left = left.copy()
                left[number[0]] = rng.choice([np.nan, np.inf])
            if len(number):
                out.append(TiePair(a, b, left[number], right[number], number, number))
    return tuple(out)


def _control(
    kind: str, truth: Poses, cameras: tuple[Camera, ...], rng: np.random.Generator
) -> tuple[GroundControl, ...]:
    middle = truth.positions_m[:, :2].mean(axis=0)
    places = [
        np.array([*(middle + rng.uniform(-40.0, 40.0, 2)), 0.0])
        for _ in range(2 if kind == "two only" else 5)
    ]
    if kind == "none":
        return ()
    if kind == "same place":
        places = [places[0]] * len(places)
    out = []
    for k, place in enumerate(places):
        px = [truth[i].image_from_ground(c, place) for i, c in enumerate(cameras)]
        seen = [(i, float(x[0]), float(x[1])) for i, x in enumerate(px) if np.isfinite(x).all()]
        if kind == "seen once":
            seen = seen[:1]
        if kind == "parallel rays" and seen:
            seen = [(seen[0][0], seen[0][1] + d, seen[0][2]) for d in (0.0, 1e-9)]
        enu = place + (rng.normal(0.0, 1e6, 3) if kind == "absurd" else 0.0)
        if kind == "not finite":
            enu = np.where(rng.random(3) < 0.3, np.nan, enu)
        sd = np.full(3, float(rng.choice([0.02, 0.0, 1e9])))
        if seen:
            out.append(GroundControl(f"P{k}", enu, sd, bool(rng.random() < 0.2), tuple(seen)))
    return tuple(out)
