"""Folders for what is made on the way."""

from pathlib import Path

import pytest

from geomosaic.doors.scratch import scratch_folder
from geomosaic.pipeline import cache, files


def test_what_a_killed_run_leaves_is_removed(tmp_path: Path) -> None:
    with scratch_folder(tmp_path) as folder:
        (Path(folder) / "part.tif").write_bytes(b"pixels")
        files.sweep(tmp_path)  # as the next run does, which no other one shares the folder with
        assert not Path(folder).exists()
    with scratch_folder(tmp_path) as folder:
        assert Path(folder).is_dir()
    assert not list(tmp_path.iterdir())


def test_a_new_grid_makes_other_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Heights depend on the geoid grids that PROJ finds."""
    monkeypatch.setattr(cache, "get_user_data_dir", lambda: str(tmp_path))
    before = cache._grids()
    (tmp_path / "us_nga_egm08_25.tif").write_bytes(b"grid")
    (tmp_path / "notes.txt").write_bytes(b"no grid")
    assert cache._grids() == sorted([*before, ("us_nga_egm08_25.tif", 4)])
