"""A folder is written by one process at a time."""

from pathlib import Path

import pytest

from geomosaic.errors import OutputError
from geomosaic.pipeline.folder_lock import locked_folder


def test_a_second_writer_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    with (
        locked_folder(tmp_path, "geomosaic control"),
        pytest.raises(OutputError, match="another geomosaic control is writing here; wait for it, end it"),
        locked_folder(tmp_path, "geomosaic control"),
    ):
        raise AssertionError
    with locked_folder(tmp_path, "geomosaic control"):
        assert not list(tmp_path.iterdir())
