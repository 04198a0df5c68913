"""What stages of CCD strips record."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.recording.messages import JitterSpectrum, StripOffsets, StripResiduals
from geomosaic.recording.plain import as_text, single, topic_part


class StripCalls:
    """As `StageCalls`."""

    _index = 0

    def _write(self, topic: str, message: Any) -> None:
        raise NotImplementedError

    def strip_offsets(
        self,
        pair: int,
        left: str,
        right: str,
        line: ArrayLike,
        dcol_px: ArrayLike,
        dline_px: ArrayLike,
        sd_col_px: ArrayLike,
        sd_line_px: ArrayLike,
        label: ArrayLike,
    ) -> None:
        """Offsets of a pair of strips at some lines, every eighth say; label 0 to 2 as in `ccd.model.LABELS`.

        Recorded in single precision. Each pair has its own topic.
        """
        labels = np.asarray(label, dtype=np.uint32)
        measured, bridged, unreliable = np.bincount(labels, minlength=3)[:3] / max(labels.size, 1)
        message = StripOffsets(
            pair=pair,
            left=as_text(left),
            right=as_text(right),
            line=np.asarray(line, dtype=np.uint32),
            label=labels,
            **single(dcol_px=dcol_px, dline_px=dline_px, sd_col_px=sd_col_px, sd_line_px=sd_line_px),
            share_measured=measured,
            share_bridged=bridged,
            share_unreliable=unreliable,
            stage_index=self._index,
        )
        self._write(f"/strip_offsets/{pair}", message)

    def strip_residuals(
        self,
        pair: int,
        left: str,
        right: str,
        line: ArrayLike,
        dcol_px: ArrayLike,
        dline_px: ArrayLike,
        sd_px: ArrayLike,
    ) -> None:
        """What is left between a pair's strips at the middles of blocks of lines; NaN where unknown."""
        message = StripResiduals(
            pair=pair,
            left=as_text(left),
            right=as_text(right),
            line=np.floor(line).astype(np.uint32),
            **single(dcol_px=dcol_px, dline_px=dline_px, sd_px=sd_px),
            stage_index=self._index,
        )
        self._write(f"/strip_residuals/{pair}", message)

    def jitter(self, what: str, frequency_hz: ArrayLike, across_px: ArrayLike, along_px: ArrayLike) -> None:
        """Amplitudes of what moves line by line; `what` is `found` or `left` and names the topic."""
        message = JitterSpectrum(
            **single(frequency_hz=frequency_hz, across_px=across_px, along_px=along_px),
            stage_index=self._index,
        )
        self._write(f"/jitter/{topic_part(what)}", message)
