"""What every test stands on, before numpy is imported."""

from __future__ import annotations

import gc
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from geomosaic_simulate.survey import SimulatedSurvey

# threads of the linear algebra would wait for each other on the cores that the tests share
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# modules are compiled once, not by each worker and each process that a test starts
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# a script's background job ignores Ctrl-C, and so would all its children
signal.signal(signal.SIGINT, signal.default_int_handler)

LONGEST = (
    "test_docs", "test_chosen_model",
    "test_cli_commands", "test_dask", "test_ccd_joint", "test_bad_input", "test_resume",
    "test_cli_staircase", "test_strips_command", "test_simulate_strips", "test_end_to_end", "test_stale",
    "test_ccd_rivals", "test_bundle", "test_mosaic_compose", "test_pipeline_runner", "test_ccd_radiometry",
    "test_quality_strips", "test_adjustment_surface", "test_positions_missing", "test_matching",
    "test_ccd_object_space", "test_doors_text", "test_viewer_chromium", "test_control",
    "test_degenerate_blocks", "test_mosaic_raster", "test_export_web", "test_cli_home",
    "test_control_precision", "test_composed_tiles", "test_roofs", "test_export_cog", "test_mosaic_grid",
    "test_simulate_files", "test_report_page", "test_tie_points", "test_mosaic_trim",
    "test_simulate_lifelike", "test_video_frames", "test_earlier_solution", "test_start", "test_lens_start",
    "test_recording_diff", "test_marking_chromium", "test_adjustment_shape", "test_stopping",
    "test_heights", "test_incremental", "test_fetch", "test_verdict", "test_messages", "test_report_strips",
    "test_surface_matching", "test_dirty", "test_mosaic_strips", "test_control_use",
    "test_recording_frames_gone", "test_plugin", "test_mosaic_plan",
)  # fmt: skip
"""Files that take longest go first: one that a worker is given last is what all wait for."""


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """pytest-xdist goes by how many tests a file has unless it is asked not to."""
    config.option.loadscopereorder = False


def pytest_collection_finish() -> None:
    """Three thousand tests and their modules stay to the end: the collector needn't walk them again and again."""
    gc.freeze()
    gc.set_threshold(100_000)  # as the command does


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files keep their tests together and in order."""
    first = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: first.get(item.path.stem, len(first)))


@pytest.fixture(scope="session")
def few_survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Four small frames in two lines with tags, pos.csv and cameras.json, for all tests; not to be changed."""
    from made_once import made_once
    from small_surveys import small_survey

    size = {"lines": 2, "frames_per_line": 2, "width_px": 320, "height_px": 240}
    return made_once(tmp_path_factory, "few", lambda folder: small_survey(folder, **size))


@pytest.fixture(scope="session")
def few_run(few_survey: SimulatedSurvey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of them with the defaults, for all tests; not to be changed."""
    from made_once import made_once
    from small_surveys import mosaic

    def make(run: Path) -> Path:
        files = ("--pos", few_survey.pos, "--camera", few_survey.camera)
        assert mosaic(few_survey.frames, run, *files) == 0
        return run

    return made_once(tmp_path_factory, "few-run", make)
