"""What is said of the chosen model, and what is tried."""

from __future__ import annotations

from dataclasses import replace

from adjustment_blocks import fly

from geomosaic.adjustment.model import ModelChoice, Settings
from geomosaic.adjustment.procedure import model_selection
from geomosaic.adjustment.procedure.model_selection import model_warnings


def test_two_additions_that_all_images_show():
    """Neither was judged by left-out tie points: each is said, and no residual is."""
    block = fly(1).block
    choice = ModelChoice(("turning", "readout"), (), (), shown=2)
    texts = [w.text for w in model_warnings(block, choice) if w.code == "model-chosen"]
    assert len(texts) == 2
    assert not any("left out of the solve" in text for text in texts)


def test_one_addition_judged_and_one_shown():
    block = fly(1).block
    choice = ModelChoice(("lens", "readout"), ("given", "lens"), (0.9, 0.4), shown=1)
    texts = [w.text for w in model_warnings(block, choice) if w.code == "model-chosen"]
    assert len(texts) == 2
    assert any("0.9 px" in text and "0.4 px" in text for text in texts)


def test_no_fisheye_is_tried_on_fisheyes():
    block = fly(1).block
    round_ones = tuple(replace(c, kind="fisheye", k1=0.0) for c in block.cameras)
    for cameras, tried in ((block.cameras, True), (round_ones, False)):
        now = model_selection.Model(replace(block, cameras=cameras), Settings(), None)
        names = [name for name, _ in model_selection._candidates(now, vibrating=False)]
        assert ("fisheye" in names) == tried
