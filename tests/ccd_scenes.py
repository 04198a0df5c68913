"""Overlaps of staggered CCDs with known offsets, made as arrays: texture, motion, relief, clouds, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter1d, map_coordinates

from geomosaic.ccd.model import Overlap

WIDTH, READ, MARGIN, SEPARATION, LINE_RATE = 4096, 110, 14, 2114, 3272.0
PAD, SIDE = 80, 18


@dataclass(frozen=True)
class Scene:
    overlaps: tuple[Overlap, ...]
    truth: np.ndarray  # (pairs, 2, n): dcol, dline of every left line
    wind_h: np.ndarray  # (2,) cols and lines by which clouds are moved against the ground
    seen: np.ndarray  # (pairs, n): the right strip has the line


def texture(rng, lines, cols, power=1.0):
    """Zero mean, unit deviation, amplitude falling as 1 / f^power."""
    fl, fc = np.fft.fftfreq(lines)[:, None], np.fft.rfftfreq(cols)[None, :]
    f = np.hypot(fl, fc)
    amplitude = np.maximum(f, 1 / 200) ** -power * np.exp(-2 * (np.pi * 0.5) ** 2 * f**2)
    amplitude[0, 0] = 0.0
    noise = rng.standard_normal((lines, cols), dtype=np.float32)
    out = fft.irfft2(fft.rfft2(noise) * amplitude.astype(np.float32), s=(lines, cols))
    return ((out - out.mean()) / out.std()).astype(np.float32)


def motion(rng, u):
    """(2, n): drift and jitter between the rows as the leading row's line u sees them."""
    t = u / LINE_RATE
    out = np.zeros((2, len(u)))
    for axis, scale in ((0, 1.0), (1, 0.7)):
        for hertz, size in ((0.13, 1.5), (1.1, 0.8), (4.7, 0.35), (22.0, 0.12)):
            out[axis] += (
                scale * size * rng.uniform(0.7, 1.3) * np.sin(2 * np.pi * (hertz * t + rng.uniform()))
            )
        out[axis] += rng.normal() * 1.5 + rng.normal() * 1.0 * (u / 16384)
    return out


def scene(
    seed,
    lines=16384,
    pairs=7,
    low_contrast=0.0,
    cloud=0.0,
    contrast=0.12,
    first_side=1,
    noise_dn=2.0,
    relief_m=60.0,
):
    """low_contrast, cloud: shares of the lines and of the ground so disturbed."""
    rng = np.random.default_rng(seed)
    u = np.arange(-SEPARATION - PAD, lines + PAD, dtype=float)
    shared = motion(rng, u)
    low = np.zeros(len(u))
    if low_contrast:
        field = gaussian_filter1d(rng.normal(size=len(u)), 700, mode="wrap")
        low = (field > np.quantile(field, 1 - low_contrast)).astype(float)
    low = gaussian_filter1d(low, 30)
    wind_h = np.array([rng.uniform(-5, 5), rng.uniform(-8, 8) - rng.uniform(1500, 5000) / 233.0])
    overlaps, truths, seens = [], [], []
    for k in range(pairs):
        side = first_side * (-1) ** k
        e = shared.copy()
        e[0] += rng.normal() * 0.8 + rng.normal() * 0.5 * np.sin(u / 9000 + rng.uniform(0, 6))
        e[1] += rng.normal() * 0.8 + rng.normal() * 0.5 * np.sin(u / 9000 + rng.uniform(0, 6))
        if relief_m:
            heights = gaussian_filter1d(rng.normal(size=len(u)), 400, mode="wrap")
            e[1] -= heights / heights.std() * relief_m / 233.0
        overlap, truth, seen = _pair(rng, k, side, lines, u, e, low, cloud, contrast, wind_h, noise_dn)
        overlaps.append(overlap)
        truths.append(truth)
        seens.append(seen)
    return Scene(tuple(overlaps), np.array(truths), wind_h, np.array(seens))


def _pair(rng, k, side, lines, u, e, low, cloud, contrast, wind_h, noise_dn):
    n, cols = fft.next_fast_len(len(u), real=True), READ + 2 * SIDE
    ground = texture(rng, n, cols)[: len(u)]
    n = len(u)
    ground = 600 * (1 + ground * (contrast * (1 - low) + 0.005 * low)[:, None])
    alpha = None
    if cloud:
        # patches of some hundred to two thousand lines
        m = fft.next_fast_len(n, real=True)
        field = (
            texture(rng, m, cols, 1.5)[:n] * 0.4
            + gaussian_filter1d(rng.normal(size=n), 350, mode="wrap")[:, None] * 350**0.5 * 1.9
        )
        edge = np.quantile(field, 1 - cloud)
        alpha = np.clip((field - edge) / 0.25, 0, 1)
        clouds = 1300 * (1 + 0.12 * texture(rng, m, cols, 1.4)[:n])
    c = np.arange(cols, dtype=float)

    def seen_from(offset, with_cloud):
        """The picture in which the ground of line y lies at y + offset(y), cols alike."""
        lo = offset[1] + wind_h[1] if with_cloud else offset[1]
        co = offset[0] + wind_h[0] if with_cloud else offset[0]
        at = u.copy()
        for _ in range(6):
            at = u - np.interp(at, u, lo)
        dc = np.interp(at, u, co)
        rows = np.repeat((at - u[0])[:, None], cols, 1)
        return np.stack([rows, c[None, :] - dc[:, None]])

    def picture(offset, trailing):
        out = (
            ground
            if not trailing
            else map_coordinates(ground, seen_from(offset, False), order=3, mode="nearest")
        )
        if alpha is not None:
            if trailing:
                where = seen_from(offset, True)
                a, b = (map_coordinates(x, where, order=1, mode="nearest") for x in (alpha, clouds))
            else:
                a, b = alpha, clouds
            out = out * (1 - a) + b * a
        gain, bias = rng.uniform(0.95, 1.05), rng.uniform(-10, 10)
        pattern = 1 + 0.004 * rng.normal(size=cols)
        out = out * gain * pattern + bias
        out = out + noise_dn * np.sqrt(np.clip(out, 1, None) / 600) * rng.standard_normal(
            out.shape, dtype=np.float32
        )
        return np.clip(np.rint(out), 0, 4095).astype(np.uint16)

    lead, trail = picture(e, False), picture(e, True)
    margin = MARGIN * side
    lead_cut = lead[:, SIDE : SIDE + READ]
    trail_cut = trail[:, SIDE + margin : SIDE + margin + READ]
    i = np.arange(lines)
    if side == 1:
        rows = i - int(u[0])
        left, right = lead_cut[rows], trail_cut[rows]
        truth = np.stack([np.interp(i, u, e[0]), np.interp(i, u, e[1])])
        seen = i + SEPARATION < lines
    else:
        rows = i - SEPARATION - int(u[0])
        left, right = trail_cut[rows], lead_cut[rows]
        at = i - float(SEPARATION)
        for _ in range(6):
            at = i - SEPARATION - np.interp(at, u, e[1])
        truth = -np.stack([np.interp(at, u, e[0]), np.interp(at, u, e[1])])
        seen = i - SEPARATION >= 0
    valid = np.repeat(seen[:, None], READ, 1)
    return Overlap(k, left, right, side, valid), truth, seen
