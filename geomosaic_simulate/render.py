"""What a camera sees of the ground: exact collinearity, the image sampled without aliasing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline

from geomosaic.arrays import Bytes, Floats, Floats32
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import GroundSurface, flat_ground
from geomosaic_simulate.buildings import Building
from geomosaic_simulate.landscape import Bounds
from geomosaic_simulate.readout import FrameReadout
from geomosaic_simulate.relief import RasterRelief, Relief
from geomosaic_simulate.trees import Tree, raise_trees
from geomosaic_simulate.walls import Standing, hide, raise_buildings

_STEP_PX = 16
_STRIP_PX = 256
_OVERSAMPLING = 2
_COARSE_PX = 2
_BEYOND_PX = 4
_ROWS_PER_SHAKE = 12
_SLANT_HAZY, _SLANT_END = 1.5, 3.0
"""Tangents of a ray's angle with the vertical: from where on haze hides the ground, and where it ends."""
_HAZE, _SKY, _SKY_RAD = (198.0, 206.0, 212.0), (96.0, 142.0, 200.0), 0.5


@dataclass(frozen=True)
class World:
    """Where the ground lies: its relief, what stands up on it, and the two coordinate systems.

    trees: (n, 4) as `Landscape.trees_in`: paraboloids of this radius at the ground and this height.
    """

    work_frame: LocalFrame
    projection: MapProjection
    relief: Relief | RasterRelief
    buildings: tuple[Building, ...] = ()
    trees: Floats | None = None

    def map_from_enu(self, enu_m: Floats) -> Floats:
        """Easting, northing, ellipsoidal height (..., 3) of points in the work frame."""
        geodetic = self.work_frame.geodetic_from_enu(enu_m)
        en = self.projection.map_from_geodetic(geodetic[..., 0], geodetic[..., 1])
        return np.concatenate([en, geodetic[..., 2:]], axis=-1)

    def enu_from_map(self, easting_m: Floats, northing_m: Floats, height_ellipsoidal_m: Floats) -> Floats:
        """Points (..., 3) in the work frame of map coordinates and ellipsoidal heights."""
        lonlat = self.projection.geodetic_from_map(easting_m, northing_m)
        return self.work_frame.enu_from_geodetic(lonlat[..., 0], lonlat[..., 1], height_ellipsoidal_m)

    def surface_under(self, pose: Pose, camera: Camera) -> GroundSurface:
        """The ground that a frame can see, fine enough that its chords are off by about a millimetre."""
        reach = 1.5 * float(np.abs(pose.position_m[:2]).max()) + 2000.0
        level = flat_ground(self.work_frame, self.relief.base_m, reach)
        if self.relief.amplitude_m == 0.0:
            return level
        lowest = GroundSurface("flat", 0.0, 0.0, 1.0, np.full((1, 1), self._lowest_up(pose)))
        outline = outline_of(camera, pose, lowest)
        spacing = self.relief.mesh_m
        low, high = outline[:, :2].min(axis=0) - 20.0, outline[:, :2].max(axis=0) + 20.0
        east = np.arange(low[0], high[0] + spacing, spacing)
        north = np.arange(low[1], high[1] + spacing, spacing)
        e, n = np.meshgrid(east, north)
        up = level.up_at(e, n)
        for _ in range(4):
            at = self.map_from_enu(np.stack([e, n, up], axis=-1))
            up = up + self.relief.height_at(at[..., 0], at[..., 1]) - at[..., 2]
        return GroundSurface("dem", float(east[0]), float(north[0]), spacing, up)

    def _lowest_up(self, pose: Pose) -> float:
        sinks = float((pose.position_m[:2] ** 2).sum()) / 12.7e6
        return (
            self.relief.base_m - 0.5 * self.relief.amplitude_m - self.work_frame.height_ellipsoidal_m - sinks
        )


def outline_of(camera: Camera, pose: Pose, ground: GroundSurface, per_side: int = 8) -> Floats:
    """A frame's outline on the ground (4 * per_side, 3), as far as it is seen through the haze."""
    origin, ray = FrameReadout().rays(camera, pose, camera.border_px(per_side))
    return ground.intersect(origin, _lowered(ray))


def _lowered(ray: Floats) -> Floats:
    """Rays that meet the ground no farther off than _SLANT_END times the height: flatter ones are lowered."""
    level = np.hypot(ray[..., 0], ray[..., 1])
    return np.concatenate([ray[..., :2], np.minimum(ray[..., 2], -level / _SLANT_END)[..., None]], axis=-1)


@dataclass(frozen=True)
class Sight:
    """Where each pixel of a frame looks: cubic splines through rays traced every _STEP_PX pixels.

    East, north and height of the ground on the map, and how east and north move along the ray per metre
    of height. Between the nodes the splines are off by less than 0.001 pixel on smooth ground. elevation: of
    the ray above the horizon (rad), where haze and sky are seen.
    """

    easting: RectBivariateSpline
    northing: RectBivariateSpline
    height: RectBivariateSpline
    east_per_m: RectBivariateSpline
    north_per_m: RectBivariateSpline
    bounds_m: Bounds
    """West, south, east, north of all that is seen."""
    elevation: RectBivariateSpline | None = None


def sight_of(camera: Camera, pose: Pose, world: World, readout: FrameReadout | None = None) -> Sight:
    """Trace a frame's rays to the ground, or to where haze hides it."""
    readout = readout or FrameReadout()
    step_px = float(np.clip(world.relief.detail_m * camera.focal_length_px / 4.0 / _depth_m(pose, world),
                            4.0, _STEP_PX))  # fmt: skip
    if readout.shakes:
        shake_px = camera.height_px / readout.time_s / float(readout.frequency_hz.max())
        step_px = float(np.clip(shake_px / _ROWS_PER_SHAKE, 1.0, step_px))
    rows, cols = (_nodes(n, step_px) for n in (camera.height_px, camera.width_px))
    image = np.stack(np.meshgrid(cols, rows), axis=-1)
    origin, seen = readout.rays(camera, pose, image)
    ray = _lowered(seen)
    ground = world.surface_under(pose, camera).intersect(origin, ray)
    at, above = (world.map_from_enu(p) for p in (ground, ground + ray / ray[..., 2:] * 10.0))
    rise = (above[..., :2] - at[..., :2]) / (above[..., 2:] - at[..., 2:])
    layers = (at[..., 0], at[..., 1], at[..., 2], rise[..., 0], rise[..., 1])
    low, high = at[..., :2].min(axis=(0, 1)), at[..., :2].max(axis=(0, 1))
    splines = [RectBivariateSpline(rows, cols, z) for z in layers]
    east, north, height, east_per_m, north_per_m = splines
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    up = np.arctan2(seen[..., 2], np.hypot(seen[..., 0], seen[..., 1]))
    elevation = RectBivariateSpline(rows, cols, up) if up.max() > -np.arctan(1.0 / _SLANT_HAZY) else None
    return Sight(east, north, height, east_per_m, north_per_m, bounds, elevation)


def _depth_m(pose: Pose, world: World) -> float:
    return max(float(pose.position_m[2] + world.work_frame.height_ellipsoidal_m - world.relief.base_m), 1.0)


def _nodes(size_px: int, step_px: float) -> Floats:
    """Where rays are traced: from a little outside one edge to a little outside the other."""
    count = max(int(np.ceil((size_px + 2 * _BEYOND_PX) / step_px)), 4) + 1
    return np.linspace(-_BEYOND_PX, size_px + _BEYOND_PX, count)


def render(
    camera: Camera,
    pose: Pose,
    world: World,
    sight: Sight,
    texture: Bytes,
    west_m: float,
    north_m: float,
    pixel_m: float,
    moved_px: float = 0.0,
) -> Floats32:
    """The frame (rows, cols, 3) before exposure and noise, each pixel the mean of 2 x 2 bicubic samples.

    Args: texture: a window of the ground's image whose outer corner is west_m, north_m and which
    covers `sight.bounds_m` with a margin of 4 pixels; moved_px: how far a rolling shutter moves things.
    """
    near = standing_buildings(camera, pose, world, moved_px)
    trees = standing_trees(camera, pose, world, moved_px)
    out = np.empty((camera.height_px, camera.width_px, 3), dtype=np.float32)
    cols = _samples(0, camera.width_px)
    for top in range(0, camera.height_px, _STRIP_PX):
        bottom = min(top + _STRIP_PX, camera.height_px)
        rows = _samples(top, bottom)
        east, north = (_dense(s, top, bottom, camera.width_px) for s in (sight.easting, sight.northing))
        ground = (east.copy(), north.copy()) if trees else (east, north)
        top_m = np.full(east.shape if near and trees else (1, 1), -np.inf)
        walls = raise_buildings(near, sight, rows, cols, east, north, top_m)
        if trees:
            others = (sight.height, sight.east_per_m, sight.north_per_m)
            rays = (*ground, *(_dense(s, top, bottom, camera.width_px) for s in others))
            for window, hit in raise_trees(trees, rays, rows, cols, east, north, top_m):
                hide(walls, window, hit)
        x = ((east - west_m) / pixel_m - 0.5).astype(np.float32)
        y = ((north_m - north) / pixel_m - 0.5).astype(np.float32)
        seen = cv2.remap(texture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        for window, hit, colour in walls:
            seen[window][hit] = colour[hit]
        size = (camera.width_px, bottom - top)
        out[top:bottom] = cv2.resize(seen.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return out


def haze(light: Floats32, sight: Sight) -> None:
    """Hide what is far behind haze, and paint the sky above the horizon (in place)."""
    if sight.elevation is None:
        return
    up_rad = sight.elevation(*(np.arange(n) + 0.5 for n in light.shape[:2]))
    slant = 1.0 / np.tan(np.clip(-up_rad, 1e-3, 1.57))
    hidden = np.clip((slant - _SLANT_HAZY) / (_SLANT_END - _SLANT_HAZY), 0.0, 1.0)
    blue = np.clip(up_rad / _SKY_RAD, 0.0, 1.0)[..., None]
    far = (1.0 - blue) * np.array(_HAZE) + blue * np.array(_SKY)
    light += (hidden**2 * (3.0 - 2.0 * hidden))[..., None].astype(np.float32) * (far - light)


def _samples(start_px: int, end_px: int) -> Floats:
    """Where the samples of pixels start ... end lie, corner origin."""
    return np.asarray((np.arange(start_px * _OVERSAMPLING, end_px * _OVERSAMPLING) + 0.5) / _OVERSAMPLING)


def _dense(spline: RectBivariateSpline, top_px: int, bottom_px: int, width_px: int) -> Floats:
    """A layer of the sight at the samples of a strip: linear between points _COARSE_PX apart.

    Off by an eighth of the squared step times the curvature: 2e-4 pixel for a lens of k1 = -0.1.
    """
    rows = np.arange(top_px - _COARSE_PX / 2, bottom_px + _COARSE_PX, _COARSE_PX)
    cols = np.arange(-_COARSE_PX / 2, width_px + _COARSE_PX, _COARSE_PX)
    coarse, times = spline(rows, cols), _COARSE_PX * _OVERSAMPLING
    fine = cv2.resize(coarse, None, fx=times, fy=times, interpolation=cv2.INTER_LINEAR)
    height, width = (bottom_px - top_px) * _OVERSAMPLING, width_px * _OVERSAMPLING
    return np.asarray(fine[times : times + height, times : times + width])


def standing_buildings(camera: Camera, pose: Pose, world: World, moved_px: float) -> list[Standing]:
    """The buildings in a frame's view, the farthest from its nadir point first."""
    found = []
    for b in world.buildings:
        base = float(world.relief.height_at(b.easting_m, b.northing_m))
        outline = np.tile(b.outline_m(), (2, 1))
        heights = np.repeat([base - 1.0 - 0.3 * b.half_length_m, base + b.top_m], 4)
        enu = world.enu_from_map(outline[:, 0], outline[:, 1], heights)
        px = pose.image_from_ground(camera, enu)
        if np.isnan(px).any():
            continue
        low, high = px.min(axis=0) - 2.0 - moved_px, px.max(axis=0) + 2.0 + moved_px
        if (high > 0.0).all() and low[0] < camera.width_px and low[1] < camera.height_px:
            distance = float(np.hypot(*(enu[:, :2].mean(axis=0) - pose.position_m[:2])))
            found.append((distance, Standing(b, base, low, high)))
    return [s for _, s in sorted(found, key=lambda pair: -pair[0])]


def standing_trees(camera: Camera, pose: Pose, world: World, moved_px: float) -> list[Tree]:
    """The trees in a frame's view."""
    if world.trees is None or not len(world.trees):
        return []
    x, y, radius, height = world.trees.T
    base = world.relief.height_at(x, y)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    square = world.trees[:, None, :2] + 1.3 * radius[:, None, None] * signs
    around = np.concatenate([square, square], axis=1)
    levels = np.repeat(np.stack([base - 0.5 * radius, base + height], axis=1), 4, axis=1)
    px = pose.image_from_ground(camera, world.enu_from_map(around[..., 0], around[..., 1], levels))
    low, high = px.min(axis=1) - 2.0 - moved_px, px.max(axis=1) + 2.0 + moved_px
    seen = (high > 0.0).all(axis=1) & (low < [camera.width_px, camera.height_px]).all(axis=1)
    return [
        Tree(float(x[i]), float(y[i]), float(radius[i]), float(height[i]), float(base[i]), low[i], high[i])
        for i in np.flatnonzero(seen)
    ]


def develop(
    light: Floats32, gain: float, vignetting: float, blur_px: float, noise: float, rng: np.random.Generator
) -> Floats32:
    """Exposure: blur, vignetting (the share of light lost in the corners, growing with r²), gain, noise.

    Returns values of [0, 255], not rounded.
    """
    rows, cols = light.shape[:2]
    if blur_px > 0.0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), blur_px), dtype=np.float32)
    x = (np.arange(cols, dtype=np.float32) + 0.5 - cols / 2.0) / np.hypot(rows, cols) * 2.0
    y = (np.arange(rows, dtype=np.float32) + 0.5 - rows / 2.0) / np.hypot(rows, cols) * 2.0
    kept = (gain * (1.0 - vignetting * (x * x + (y * y)[:, None]))).astype(np.float32)
    exposed = np.empty_like(light)
    for top in range(0, rows, _STRIP_PX):
        part = np.s_[top : top + _STRIP_PX]
        exposed[part] = light[part] * kept[part, :, None]
        if noise > 0.0:
            exposed[part] += np.float32(noise) * rng.standard_normal(light[part].shape, dtype=np.float32)
    return np.asarray(np.clip(exposed, 0.0, 255.0, out=exposed))
