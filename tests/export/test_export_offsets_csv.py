"""offsets.csv: what is written, and that strangers' files are read with care."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geomosaic.ccd.model import LABELS, PairOffsets
from geomosaic.errors import GeomosaicError
from geomosaic.export.offsets_csv import read_true_offsets, write_offsets_csv
from geomosaic_simulate.strip_plan import StripPlan

GEOMETRY = StripPlan(ccds=4, lines=2300, dead="2", short="4:2200").geometry()


def pair(k: int, n: int) -> PairOffsets:
    rng = np.random.default_rng(k)
    a, b, c, d = rng.normal(0, 3, (4, n))
    return PairOffsets(k, a, b, np.abs(c), np.abs(d), rng.integers(0, 3, n).astype(np.uint8))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "offsets.csv"
    write_offsets_csv(path, (pair(2, 2300),))
    return path


def test_the_text(tmp_path: Path) -> None:
    path = tmp_path / "o.csv"
    three = np.array([0.12345, -2.0, -0.00001])
    offsets = PairOffsets(5, three, 2 * three, abs(three), 3 * abs(three), np.array([0, 1, 2], np.uint8))
    write_offsets_csv(path, (offsets,))
    assert path.read_bytes() == (
        b"pair,line,dcol_px,dline_px,sd_col_px,sd_line_px,label\n"
        b"5,0,0.1234,0.2469,0.1234,0.3704,measured\n"
        b"5,1,-2.0000,-4.0000,2.0000,6.0000,bridged\n"
        b"5,2,0.0000,0.0000,0.0000,0.0000,unreliable\n"
    )


def test_what_was_written_is_read(path: Path) -> None:
    found, wanted = read_true_offsets(path, GEOMETRY), pair(2, 2300)
    assert found.keys() == {2}
    np.testing.assert_allclose(found[2].T, [wanted.dcol_px, wanted.dline_px], atol=5.1e-5)


def test_pieces_join(tmp_path: Path) -> None:
    """More lines than are written at once."""
    geometry = StripPlan(ccds=2, lines=10001).geometry()
    write_offsets_csv(tmp_path / "o.csv", (pair(0, 10001),))
    found, wanted = read_true_offsets(tmp_path / "o.csv", geometry)[0], pair(0, 10001)
    np.testing.assert_allclose(found.T, [wanted.dcol_px, wanted.dline_px], atol=5.1e-5)
    labels = [row.rpartition(",")[2] for row in (tmp_path / "o.csv").read_text().splitlines()[1:]]
    assert labels == [LABELS[k] for k in wanted.label]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("dline_px", "d", "hasn't the columns"),
        ("\n2,7,", "\n2,8,", "hasn't the lines 0 to 2299 of pair 2"),
        ("\n2,", "\n1,", "hasn't the pairs of this geometry, which are 2"),
    ],
)
def test_bad_files_are_one_clear_line(path: Path, old: str, new: str, words: str) -> None:
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(GeomosaicError, match=words) as caught:
        read_true_offsets(path, GEOMETRY)
    assert "\n" not in str(caught.value) and "offsets.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("2,9,nan,1,1,1,measured", "dcol_px that is not finite"),
        ("2,9,1,inf,1,1,measured", "dline_px that is not finite"),
        ("2,9,x,1,1,1,measured", "no numbers"),
        ("2,9,1", "a row is short"),
        ("2,9.5,1,1,0.5,1,bridged", "lines 0 to 2299 of pair 2"),
    ],
)
def test_bad_rows_are_one_clear_line(path: Path, row: str, words: str) -> None:
    rows = path.read_text().splitlines()
    rows[10] = row
    path.write_text("\n".join(rows))
    with pytest.raises(GeomosaicError, match=words) as caught:
        read_true_offsets(path, GEOMETRY)
    assert "\n" not in str(caught.value) and "offsets.csv" in str(caught.value)


@pytest.mark.parametrize(
    "data",
    [b"", b"\x00\xff" * 100, b"pair,line\n", b"pair,line,dcol_px,dline_px,sd_col_px,sd_line_px,label\n"],
)
def test_no_table_at_all(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    with pytest.raises(GeomosaicError, match=r"offsets\.csv"):
        read_true_offsets(path, GEOMETRY)


def test_missing_and_too_large_files(path: Path) -> None:
    with pytest.raises(GeomosaicError, match="no such file"):
        read_true_offsets(path.with_name("none.csv"), GEOMETRY)
    with path.open("r+b") as file:
        file.truncate(3_000_000_000)
    with pytest.raises(GeomosaicError, match="too large"):
        read_true_offsets(path, GEOMETRY)
