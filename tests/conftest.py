"""What every test stands on, before numpy is imported."""

from __future__ import annotations

import gc
import os
import signal
import sys

import pytest

# threads of the linear algebra would wait for each other on the cores that the tests share
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# modules are compiled once, not by each worker and each process that a test starts
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# a script's background job ignores Ctrl-C, and so would all its children
signal.signal(signal.SIGINT, signal.default_int_handler)

LONGEST = (
    "test_docs", "test_chosen_model", "test_ccd_joint", "test_dask", "test_end_to_end", "test_resume",
    "test_degenerate_blocks", "test_cli_staircase", "test_bad_input", "test_ccd_rivals", "test_control",
    "test_cli_commands", "test_strips_command", "test_mosaic_trim", "test_surface_matching", "test_fuzz_short",
    "test_bundle", "test_bundle_oracle", "test_adjustment_surface", "test_bench_flights", "test_recording_kills",
    "test_ccd_radiometry", "test_design_effect", "test_stale", "test_placement", "test_start", "test_dirty",
    "test_mosaic_tones", "test_survey_makefile", "test_mosaic_grid", "test_recording_frames_gone", "test_plugin",
    "test_python", "test_messages", "test_example_package", "test_cli_home",
)  # fmt: skip
"""Files that take longest go first: one that a worker is given last is what all wait for."""


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """pytest-xdist goes by how many tests a file has unless it is told not to."""
    config.option.loadscopereorder = False


def pytest_collection_finish() -> None:
    """Three thousand tests and their modules stay to the end: the collector needn't walk them again and again."""
    gc.freeze()
    gc.set_threshold(100_000)  # as the command does


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files keep their tests together and in order."""
    first = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: first.get(item.path.stem, len(first)))
