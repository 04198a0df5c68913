"""What stands where in Rerun."""

from __future__ import annotations

from typing import Any

from geomosaic.recording.file.model import Recording
from geomosaic.recording.rerun.block_view import BLOCK
from geomosaic.recording.rerun.image_view import CHIP, FRAME, FRAME_TEXT, MOSAIC, STRIPS
from geomosaic.recording.rerun.list_view import LISTS, PICK
from geomosaic.recording.rerun.plan_view import NAME, PLAN
from geomosaic.recording.rerun.rounds_view import BOUNDS, SPECTRUM, STAGES, STEPS
from geomosaic.recording.rerun.strip_view import LINE, STRIP_PLAN, strip_views


def layout(recording: Recording | None) -> Any:
    """The blueprint: of strips where the recording has any; of frames else, and while a run is on."""
    import rerun.blueprint as rrb

    strips = recording is not None and bool(recording.strips)
    shown = _of_strips(recording) if recording is not None and strips else _of_frames()
    return rrb.Blueprint(
        shown,
        rrb.TimePanel(timeline=LINE if strips else PICK, state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def _of_frames() -> Any:
    import rerun.blueprint as rrb

    return rrb.Vertical(
        rrb.Horizontal(
            rrb.Tabs(
                rrb.Spatial2DView(origin=PLAN, name=NAME),
                rrb.Spatial3DView(origin=BLOCK, name="block: cameras, tie points, surface"),
            ),
            rrb.Vertical(
                rrb.Horizontal(
                    rrb.TextDocumentView(origin=f"{LISTS}/pairs", name="worst pairs"),
                    rrb.TextDocumentView(origin=f"{LISTS}/frames", name="frames moved most"),
                ),
                rrb.Spatial2DView(
                    origin=CHIP, name="worst pairs: green counts, red rejected, grey took no part"
                ),
                rrb.Horizontal(
                    rrb.Spatial2DView(origin=FRAME, name=f"frame at {PICK}"),
                    rrb.TextDocumentView(origin=FRAME_TEXT, name="picked frame"),
                    rrb.Spatial2DView(origin=MOSAIC, name="mosaic"),
                ),
                row_shares=[4, 4, 3],
            ),
            column_shares=[5, 4],
        ),
        rrb.Horizontal(
            rrb.TextDocumentView(origin=f"{LISTS}/said", name="verdict and warnings"),
            _drawn(STAGES, "stages, red: not finished"),
            _drawn(STEPS, "steps: cost and sigma, log"),
            _log(),
            column_shares=[4, 3, 3, 5],
        ),
        row_shares=[13, 6],
    )


def _of_strips(recording: Recording) -> Any:
    import rerun.blueprint as rrb

    return rrb.Vertical(
        rrb.Horizontal(
            rrb.Grid(*strip_views(recording), grid_columns=2),
            rrb.Vertical(
                rrb.Spatial2DView(origin=STRIPS, name="strips as read, first lines at the left"),
                rrb.Horizontal(
                    rrb.Spatial2DView(origin=STRIP_PLAN, name="plan, m"),
                    rrb.Spatial2DView(origin=MOSAIC, name="scene"),
                ),
                _drawn(SPECTRUM, "jitter, px by Hz, logarithmic"),
            ),
            column_shares=[3, 2],
        ),
        rrb.Horizontal(
            rrb.TextDocumentView(origin=f"{LISTS}/strips", name="greys, and why lines are bridged"),
            rrb.TextDocumentView(origin=f"{LISTS}/said", name="warnings"),
            _drawn(STAGES, "stages, red: not finished"),
            _log(),
            column_shares=[4, 2, 3, 4],
        ),
        row_shares=[7, 3],
    )


def _drawn(origin: str, name: str) -> Any:
    import rerun.blueprint as rrb

    x, y = BOUNDS[origin]
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=rrb.VisualBounds2D(x_range=x, y_range=y))


def _log() -> Any:
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

    columns = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn("time", visible=False)],
        text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
    )
    monospace = rrb.TextLogFormat(monospace_body=True)
    return rrb.TextLogView(
        origin="/log", name="log: level, stage, line", columns=columns, format_options=monospace
    )
