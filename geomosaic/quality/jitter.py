"""Spectra of what moves line by line: the offsets found, and what is left of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len, rfft

from geomosaic.arrays import Floats
from geomosaic.ccd.model import StripOffsets
from geomosaic.constants import tuned
from geomosaic.quality.strips import BLOCK_LINES, StripQuality

HIGHEST_HZ = tuned(100.0, "Hz", "end of the spectra: beyond, they show the smoothing of offsets only")
_FINER = tuned(4, "times", "zero padding: 1 loses 15 % of a peak, 2 4 %, 4 1 %; more takes memory")
_LEAST_SAMPLES = tuned(32, "samples", "of a spectrum: fewer are mostly trend; more exclude short scenes")
_LEAST_KNOWN = tuned(0.5, "share", "of measured blocks: less shows bridged gaps; more excludes clouds")


@dataclass(frozen=True)
class Spectrum:
    """Amplitudes (f,) of dcol (across) and dline (along), root mean square over the pairs; empty of nothing.

    A sine of 0.3 px in every pair shows as a peak of 0.3.
    """

    frequency_hz: Floats
    across_px: Floats
    along_px: Floats


def jitter_spectrum(offsets: StripOffsets, line_rate_hz: float) -> Spectrum:
    """What moves the offsets, up to 100 Hz.

    An offset is the difference of the pointing at two times T apart. Jitter of frequency f shows with
    `2 |sin(pi f T)|` of its amplitude, and not at all where f T is whole.
    """
    return _spectrum([np.stack([p.dcol_px, p.dline_px]) for p in offsets.pairs], line_rate_hz)


def residual_spectrum(quality: StripQuality, line_rate_hz: float) -> Spectrum:
    """What is left, up to half a block's frequency, from each pair's first measured block to its last.

    Pairs of which less than half of that was measured are left out. A block's residual is a mean over its
    lines, which damps what is fast: that is made good.
    """
    found = []
    for pair in quality.pairs:
        known = np.isfinite(pair.residual_px).all(axis=1)
        blocks = np.flatnonzero(known)
        if blocks.size and blocks.size >= _LEAST_KNOWN * (blocks[-1] - blocks[0] + 1):
            at = np.arange(blocks[0], blocks[-1] + 1)
            found.append(np.stack([np.interp(at, blocks, v[known]) for v in pair.residual_px.T]))
    rate = line_rate_hz / BLOCK_LINES
    raw = _spectrum(found, rate)
    kept = np.sinc(raw.frequency_hz / rate)
    return Spectrum(raw.frequency_hz, raw.across_px / kept, raw.along_px / kept)


def peaks_by_bin(spectrum: Spectrum, most: int = 60) -> Spectrum:
    """The largest amplitudes in each of at most `most` logarithmic bins; frequency 0 is left out.

    A bin's frequency is that of the larger of its two amplitudes. Bins that hold no frequency are left out.
    """
    moving = spectrum.frequency_hz > 0.0
    frequency, across, along = (
        v[moving] for v in (spectrum.frequency_hz, spectrum.across_px, spectrum.along_px)
    )
    if not frequency.size:
        return Spectrum(frequency, across, along)
    edges = np.geomspace(frequency[0], frequency[-1], most + 1)
    bins = np.searchsorted(edges[1:-1], frequency, side="right")
    starts = np.flatnonzero(np.diff(bins, prepend=-1))
    larger = np.split(np.maximum(across, along), starts[1:])
    return Spectrum(
        frequency[starts + [int(np.argmax(v)) for v in larger]],
        np.maximum.reduceat(across, starts),
        np.maximum.reduceat(along, starts),
    )


def _spectrum(series: Sequence[Floats], rate_hz: float) -> Spectrum:
    """Of series (2, n), without their straight trends, through Hann's window; padded to finer steps."""
    series = [s for s in series if s.shape[1] >= _LEAST_SAMPLES]
    if not series:
        return Spectrum(np.empty(0), np.empty(0), np.empty(0))
    size = next_fast_len(_FINER * max(s.shape[1] for s in series), real=True)
    frequency = np.arange(size // 2 + 1) * (rate_hz / size)
    wanted = frequency <= min(HIGHEST_HZ, rate_hz / 2)
    power = np.zeros((2, int(wanted.sum())))
    for s in series:
        window = np.hanning(s.shape[1])
        amplitude = 2.0 / window.sum() * np.abs(rfft(_levelled(s) * window, size, axis=1))
        power += amplitude[:, wanted] ** 2 / len(series)
    across, along = np.sqrt(power)
    return Spectrum(frequency[wanted], across, along)


def _levelled(series: Floats) -> Floats:
    """Series (2, n) less the straight lines through them."""
    at = np.linspace(-1.0, 1.0, series.shape[1])
    apart = series - series.mean(axis=1, keepdims=True)
    return np.asarray(apart - np.outer(apart @ at / (at @ at), at))
