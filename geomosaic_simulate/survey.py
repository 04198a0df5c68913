"""The front function: a simulated survey with its truth, in one folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomosaic.arrays import Floats, Floats32
from geomosaic.camera.interior import Camera
from geomosaic.errors import OutputError
from geomosaic.geodesy.mapcrs import MapProjection, utm_crs
from geomosaic_simulate import control
from geomosaic_simulate.changing import (
    cars_at,
    changes_at,
    glitter,
    gusts,
    paint_cars,
    paint_changes,
    sway,
)
from geomosaic_simulate.flight import Flight, Observed, battery_offset, fly, observe, position_bias
from geomosaic_simulate.landscape import Bounds, Landscape
from geomosaic_simulate.light import automatic_gain, clouds_shade, hot_spot, motion_blur, shaken
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.rasters import Texture, write_cover, write_heights, write_ortho
from geomosaic_simulate.readout import FrameReadout, readout_of
from geomosaic_simulate.relief import Relief, hills, raster_height_m, raster_relief
from geomosaic_simulate.render import Sight, World, develop, haze, outline_of, render, sight_of
from geomosaic_simulate.spread import in_threads
from geomosaic_simulate.terrain import GroundImage
from geomosaic_simulate.write import (
    CAR_COLUMNS,
    POSITIONS_COLUMNS,
    car_rows,
    copies_of,
    frame_bytes,
    frame_name,
    opensfm_camera,
    pos_rows,
    true_positions,
    write_bytes,
    write_csv,
    write_json,
)

Progress = Callable[[int, int, str], None]
CHANGE_COLUMNS = ("west_m", "south_m", "east_m", "north_m")
_DEM_MARGIN_M = 60.0
_DEM_REACH = 0.3


@dataclass(frozen=True)
class SimulatedSurvey:
    """Where a simulated survey lies. `pos` is None where the POS is in the frames' EXIF alone."""

    frames: Path
    pos: Path | None
    camera: Path
    positions: Path
    ortho: Path
    dem: Path
    dsm: Path | None
    cover: Path | None
    moving_cars: Path | None
    changes: Path | None
    truth: Path
    control: Path | None
    gcp_list: Path | None
    true_control: Path | None
    dirty: Path | None = None


def _silent(done: int, total: int, text: str) -> None:
    pass


def simulate_frames(
    out: Path, plan: SurveyPlan, progress: Progress = _silent, drawn: Mapping[str, Any] | None = None
) -> SimulatedSurvey:
    """Write a survey: frames, pos.csv, cameras.json, and truth/ with poses, ortho, DEM and every error drawn.

    drawn: what chance made of the plan (`dirty.DirtySurvey.summary`), for truth/dirty.json.
    Equal plans write equal bytes. A folder that holds frames which this function didn't write is left
    alone (`OutputError`).
    """
    names = [frame_name(plan, i) for i in range(plan.frames)]
    copies = copies_of(plan)
    _check_folder(out, [*(names[i] for i in plan.kept), *copies.values()])
    if plan.dem is not None:
        plan = dataclasses.replace(
            plan, ground_height_m=raster_height_m(plan.dem, plan.lon_deg, plan.lat_deg)
        )
    flight = fly(plan)
    observed = observe(plan, flight)
    camera, reported = plan.camera(), plan.reported_camera()
    world = world_of(plan, flight)
    paths = _paths(out, plan)
    if drawn is not None:
        paths = dataclasses.replace(paths, dirty=out / "truth" / "dirty.json")
        write_json(out / "truth" / "dirty.json", drawn)

    write_json(paths.truth, _truth(plan, flight, observed, world, names))
    write_json(
        out / "truth" / "cameras.json", opensfm_camera(camera, plan.camera_model, plan.rolling_shutter_s)
    )
    write_json(paths.camera, opensfm_camera(reported, plan.camera_model, plan.reported_readout_s()))
    rows = true_positions(plan, flight, observed, world.projection)
    write_csv(paths.positions, POSITIONS_COLUMNS, rows)
    if paths.pos:
        write_csv(paths.pos, *pos_rows(plan, observed))

    readouts = [readout_of(plan, flight, i) for i in range(plan.frames)]
    sights = [sight_of(camera, flight.poses[i], world, readouts[i]) for i in range(plan.frames)]
    if plan.control_points:
        bounds = [s.bounds_m for s in sights]
        points = control.true_points(plan, camera, flight.poses, readouts, world, bounds)
        _write_control(plan, paths, points, names, world)
    scratch = out / "truth" / ".texture.part"
    try:
        texture = _write_ground(plan, paths, scratch, camera, flight, world, sights, progress)

        inner = inner_bounds(flight, world)
        changes = changes_at(landscape_of(plan), plan.changes, plan.change_px * plan.pixel_m, inner)
        if paths.changes:
            write_csv(paths.changes, CHANGE_COLUMNS, changes.tolist())
        cars = [
            cars_at(landscape_of(plan), plan.moving_cars, float(flight.time_s[i]), sights[i].bounds_m)
            for i in range(plan.frames)
        ]
        if paths.moving_cars:
            kept = plan.kept
            rows = car_rows([names[i] for i in kept], [cars[i] for i in kept])
            write_csv(paths.moving_cars, CAR_COLUMNS, rows)

        def image(i: int) -> bytes:
            seen = (sights[i], texture, cars[i], changes)
            light, automatic = _frame(plan, camera, flight, readouts[i], world, *seen, i)
            return frame_bytes(plan, reported, flight, observed, i, light, automatic)

        for n, (i, data) in enumerate(zip(plan.kept, in_threads(image, plan.kept), strict=True)):
            for name in (names[i], copies.get(i)):
                if name:
                    write_bytes(paths.frames / name, data)
            progress(n + 1, len(plan.kept), "frames")
    finally:
        scratch.unlink(missing_ok=True)
    return paths


def _write_control(
    plan: SurveyPlan,
    paths: SimulatedSurvey,
    points: Sequence[control.SurveyedPoint],
    names: Sequence[str],
    world: World,
) -> None:
    assert paths.control and paths.gcp_list and paths.true_control
    surveyed = control.surveyed(plan, points)
    rows = control.control_rows(points, names, world, (0.0, 0.0))
    write_csv(paths.true_control, control.COLUMNS, rows)
    write_csv(
        paths.control, control.COLUMNS, control.control_rows(surveyed, names, world, control.SURVEYED_SD_M)
    )
    write_bytes(paths.gcp_list, control.gcp_list(surveyed, names, world.projection.crs).encode())


def world_of(plan: SurveyPlan, flight: Flight) -> World:
    """The world below a flight: map CRS of its centre, relief whose range is the plan's within its reach."""
    centre = flight.work_frame
    projection = MapProjection(utm_crs(centre.lon_deg, centre.lat_deg))
    level = World(centre, projection, hills(plan.seed, plan.ground_height_m, 0.0, 1.0, np.zeros((1, 2))))
    if plan.relief_m == 0.0 and plan.dem is None:
        return level
    camera = plan.camera()
    outlines = [
        outline_of(camera, flight.poses[i], level.surface_under(flight.poses[i], camera), per_side=12)
        for i in range(plan.frames)
        if flight.role[i] == "survey"
    ]
    shares = np.linspace(0.0, 1.0, 9)[:, None, None]
    inside = [o.mean(axis=0) + (o - o.mean(axis=0)) * shares for o in outlines]
    at = level.map_from_enu(np.stack(inside))[..., :2]
    if plan.dem is not None:
        reach = _DEM_REACH * plan.height_above_ground_m + _DEM_MARGIN_M
        low, high = at.reshape(-1, 2).min(axis=0) - reach, at.reshape(-1, 2).max(axis=0) + reach
        bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        middle = centre.lon_deg, centre.lat_deg
        raster = raster_relief(plan.dem, middle, projection, bounds, plan.pixel_m)
        return dataclasses.replace(level, relief=raster)
    relief = hills(plan.seed, plan.ground_height_m, plan.relief_m, plan.relief_wavelength_m, at)
    return dataclasses.replace(level, relief=relief)


def _frame(
    plan: SurveyPlan,
    camera: Camera,
    flight: Flight,
    readout: FrameReadout,
    world: World,
    sight: Sight,
    texture: Texture,
    cars: Floats,
    changes: Floats,
    i: int,
) -> tuple[Floats32, float]:
    """One frame as it is stored, values of [0, 255], and the gain that the camera's automatic chose."""
    pose = flight.poses[i]
    if plan.buildings_stand:
        west, south, east, north = sight.bounds_m
        near = landscape_of(plan).buildings_in((west - 20, south - 20, east + 20, north + 20))
        world = dataclasses.replace(world, buildings=tuple(near))
    if plan.trees_stand:
        world = dataclasses.replace(world, trees=landscape_of(plan).trees_in(sight.bounds_m))
    ground, west_m, north_m = texture.window(sight.bounds_m)
    glitter(ground, west_m, north_m, plan.pixel_m, landscape_of(plan), plan.rng("water", i))
    paint_changes(ground, changes, west_m, north_m, plan.pixel_m)
    paint_cars(ground, cars, west_m, north_m, plan.pixel_m)
    if plan.wind_in_trees_m:
        trees = landscape_of(plan).trees_in(sight.bounds_m)
        bent_m = gusts(trees, plan.wind_in_trees_m, plan.rng("gusts", i))
        ground = sway(ground, west_m, north_m, plan.pixel_m, trees, bent_m)
    moved_px = readout.moved_px(camera, plan.pixel_m)
    light = render(camera, pose, world, sight, ground, west_m, north_m, plan.pixel_m, moved_px)
    if plan.clouds:
        shade = clouds_shade(plan, sight, float(flight.time_s[i]), camera.width_px, camera.height_px)
        light *= shade[..., None]
    if plan.hot_spot:
        light *= hot_spot(plan, camera, pose, float(flight.time_s[i]))[..., None]
    haze(light, sight)
    if plan.exposure_time_s:
        light = motion_blur(light, smear_px(plan, camera, flight, i))
    if i in plan.numbered("blurred"):
        light = shaken(plan, light, i)
    automatic = automatic_gain(plan.auto_exposure, light)
    gain = exposure_gain(plan, i) * automatic
    light = develop(light, gain, plan.vignetting, plan.blur_px, plan.pixel_noise, plan.rng("pixels", i))
    return (light[::-1, ::-1] if i in plan.turned_frames() else light), automatic


def smear_px(plan: SurveyPlan, camera: Camera, flight: Flight, i: int) -> Floats:
    """Col and row (2,) by which the image of the ground moves while frame i is exposed."""
    right, up, _ = flight.poses.rotations[i].T @ flight.velocity_m_per_s[i]
    above_m = float(flight.lon_lat_height[i, 2]) - plan.ground_height_m
    per_m = camera.focal_length_px / max(above_m, 1.0)
    return plan.exposure_time_s * per_m * np.array([-right, up])


def inner_bounds(flight: Flight, world: World) -> Bounds:
    """West, south, east and north on the map of the inner half of the survey's nadir points."""
    of_survey = [i for i, role in enumerate(flight.role) if role == "survey"]
    at = world.map_from_enu(flight.poses.positions_m[of_survey])[:, :2]
    (west, south), (east, north) = np.quantile(at, 0.15, axis=0), np.quantile(at, 0.85, axis=0)
    return float(west), float(south), float(east), float(north)


def landscape_of(plan: SurveyPlan) -> Landscape:
    """The countryside that a plan asks for."""
    return Landscape(
        plan.seed, plan.buildings, plan.water_share, plan.smooth_forest_share, plan.hipped_roofs, plan.bridges
    )


def exposure_gain(plan: SurveyPlan, i: int) -> float:
    """How much brighter frame i was exposed: exposure_sd is of the gain's logarithm."""
    return float(np.exp(plan.exposure_sd * plan.rng("exposure", i).standard_normal()))


def _write_ground(
    plan: SurveyPlan,
    paths: SimulatedSurvey,
    scratch: Path,
    camera: Camera,
    flight: Flight,
    world: World,
    sights: list[Sight],
    progress: Progress,
) -> Texture:
    seen: list[Bounds] = [s.bounds_m for s in sights]
    border = camera.border_px(32)
    outlines = [
        np.column_stack([s.easting.ev(border[:, 1], border[:, 0]), s.northing.ev(border[:, 1], border[:, 0])])
        if role == "survey"
        else None
        for s, role in zip(sights, flight.role, strict=True)
    ]
    landscape = landscape_of(plan)
    crs = world.projection.crs
    texture = write_ortho(
        paths.ortho,
        scratch,
        crs,
        GroundImage(landscape, plan.pixel_m),
        seen,
        outlines,
        lambda n, of: progress(n, of, "ground"),
    )
    if paths.cover:
        write_cover(paths.cover, paths.ortho, landscape)
    low, high = np.min(seen, axis=0)[:2] - _DEM_MARGIN_M, np.max(seen, axis=0)[2:] + _DEM_MARGIN_M
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    spacing = 10.0 if world.relief.amplitude_m == 0.0 else world.relief.mesh_m
    write_heights(paths.dem, crs, world.relief, bounds, spacing)
    if paths.dsm:
        roofs = landscape.buildings_in(bounds) if plan.buildings_stand else ()
        trees = landscape.trees_in(bounds) if plan.trees_stand else None
        write_heights(paths.dsm, crs, world.relief, bounds, min(spacing, 0.5), roofs, trees)
    return texture


def _truth(
    plan: SurveyPlan, flight: Flight, observed: Observed, world: World, names: list[str]
) -> dict[str, Any]:
    """truth.json: the plan, the world, the errors drawn for each frame, and what is wrong on purpose."""
    turned, blurred, no_gps = (plan.numbered(field) for field in ("turned", "blurred", "no_gps"))
    out = [flight.role[i].replace("survey", "blurred" if i in blurred else "") for i in range(plan.frames)]
    frames = [
        {
            "frame": name,
            "line": int(flight.line[i]) + 1,
            "time_s": float(flight.time_s[i]),
            "true_yaw_pitch_roll_deg": flight.yaw_pitch_roll_deg[i].tolist(),
            "velocity_enu_m_per_s": flight.velocity_m_per_s[i].tolist(),
            "position_error_m": observed.position_errors_m[i].tolist(),
            "yaw_pitch_roll_error_deg": observed.attitude_errors_deg[i].tolist(),
            "exposure_gain": exposure_gain(plan, i),
            "turned": i in turned,
            "yaw_wrong": bool(observed.yaw_wrong[i]),
            "gps_outlier": bool(observed.outlier[i]) and i not in no_gps,
            "no_gps": i in no_gps,
            "battery": int(flight.battery[i]) + 1,
            "leave_out": out[i],
            **_shake(plan, flight, i),
        }
        for i, name in ((i, names[i]) for i in plan.kept)
    ]
    kinds = (
        ("turned", "turned-frame", "pixels turned by 180 degrees after the flight, tags unchanged"),
        ("yaw_wrong", "wrong-yaw", "the POS has a wrong heading"),
        ("gps_outlier", "position-outlier", f"the POS is off by {plan.gps_outlier_m:g} m"),
    )
    return {
        "seed": plan.seed,
        "plan": {**dataclasses.asdict(plan), "dem": plan.dem and plan.dem.name},
        "map_crs": world.projection.crs,
        "work_frame": dataclasses.asdict(world.work_frame),
        "relief": dataclasses.asdict(world.relief)
        if isinstance(world.relief, Relief)
        else {"base_m": world.relief.base_m, "amplitude_m": world.relief.amplitude_m},
        "camera": dataclasses.asdict(plan.camera()),
        "camera_of_turned_frames": dataclasses.asdict(plan.camera().turned(2)),
        "position_bias_m": position_bias(plan).tolist(),
        "battery_offset_m": battery_offset(plan).tolist(),
        "leave_out": [
            *({"frame": f["frame"], "reason": f["leave_out"]} for f in frames if f["leave_out"]),
            *({"frame": copy, "reason": "duplicate", "of": names[i]} for i, copy in copies_of(plan).items()),
        ],
        "frames": frames,
        "warnings": [
            {"code": code, "frame": f["frame"], "text": text}
            for f in frames
            for key, code, text in kinds
            if f[key]
        ],
    }


def _shake(plan: SurveyPlan, flight: Flight, i: int) -> dict[str, Any]:
    """How the platform shook while a frame was read, see `FrameReadout`; nothing where it didn't."""
    readout = readout_of(plan, flight, i)
    if not readout.shakes:
        return {}
    return {
        "vibration": {
            "rate_rad_per_s": readout.rate_rad_per_s.tolist(),
            "frequency_hz": readout.frequency_hz.tolist(),
            "phase_rad": readout.phase_rad.tolist(),
        }
    }


def _paths(out: Path, plan: SurveyPlan) -> SimulatedSurvey:
    truth = out / "truth"
    return SimulatedSurvey(
        frames=out / "frames",
        pos=None if plan.pos_in == "exif" else out / "pos.csv",
        camera=out / "cameras.json",
        positions=truth / "positions.csv",
        ortho=truth / "ortho.tif",
        dem=truth / "dem.tif",
        dsm=truth / "dsm.tif" if plan.buildings_stand or plan.trees_stand else None,
        cover=truth / "cover.tif" if plan.water_share + plan.smooth_forest_share > 0.0 else None,
        moving_cars=truth / "moving_cars.csv" if plan.moving_cars > 0.0 else None,
        changes=truth / "changes.csv" if plan.changes else None,
        truth=truth / "truth.json",
        control=out / "gcp.csv" if plan.control_points else None,
        gcp_list=out / "gcp_list.txt" if plan.control_points else None,
        true_control=truth / "control.csv" if plan.control_points else None,
    )


def _check_folder(out: Path, names: list[str]) -> None:
    """An older simulation may be written over by one with the same frames, nothing else."""
    try:
        (out / "frames").mkdir(parents=True, exist_ok=True)
        there = {p.name for p in (out / "frames").iterdir() if not p.name.startswith(".")}
    except OSError as error:
        raise OutputError(error.strerror or "can't be made", file=out, fix="give another folder") from error
    strange = sorted(there - set(names))
    ours = (out / "truth" / "truth.json").exists()
    if strange or (there and not ours):
        raise OutputError(
            f"holds frames of something else ({(strange or sorted(there))[0]})",
            file=out / "frames",
            fix="give an empty folder or remove them",
        )
