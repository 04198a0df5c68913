"""The codec of artefacts: exact, deterministic, and deaf to strangers."""

from __future__ import annotations

import io
import json
import math
import pickle
import tracemalloc
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from geomosaic.camera.interior import Camera
from geomosaic.composition.model import OutputGrid
from geomosaic.errors import FileError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.pipeline.artefact_reader import decode, with_texts
from geomosaic.pipeline.artefacts import content_of, encode, type_name, write
from geomosaic.pipeline.context import RunFile
from geomosaic.pipeline.former_names import present_name
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.dtm import TerrainModel
from geomosaic.survey.model import Attitude, Frame, Position, Survey


@dataclass(frozen=True)
class Inner:
    xs: NDArray[Any]


@dataclass(frozen=True)
class Outer:
    name: str
    inner: tuple[Inner, ...]
    more: dict[str, Any]


def arrays() -> st.SearchStrategy[Any]:
    dtypes = st.sampled_from(["u1", "i4", "f4", "f8", "?", ">f8", "c16", "U5", "S3"])
    return dtypes.flatmap(lambda d: hnp.arrays(d, hnp.array_shapes(min_dims=0, min_side=0, max_side=4)))


def values() -> st.SearchStrategy[Any]:
    plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
    return st.recursive(
        plain, lambda s: st.lists(s) | st.tuples(s, s) | st.dictionaries(st.text() | st.integers(), s)
    )


@given(values())
def test_plain_values_come_back_as_they_were(value: Any) -> None:
    data = encode(value)
    back = decode(data, object)
    assert repr(back) == repr(value)
    assert encode(back) == data


@given(arrays())
def test_arrays_come_back_with_type_shape_and_bytes(array: NDArray[Any]) -> None:
    back: NDArray[Any] = decode(encode(array), np.ndarray)
    assert (back.dtype, back.shape, back.tobytes()) == (array.dtype, array.shape, array.tobytes())
    assert back.flags.writeable


def a_survey() -> Survey:
    frame = Frame(
        "a b.jpg", "/x/a b.jpg", 4000, 3000, 3, "uint8", "cam",
        Position(7.125, 51.5, None, 80.25, 1.5, 1.25, 3.0, "exif"),
        Attitude(12.5, None, -0.25, 3.0, 0.5, "xmp"), time_s=1700000000.125,
    )  # fmt: skip
    camera = Camera("cam", 4000, 3000, 3666.5, 2000.25, 1499.75, k1=-0.1, focal_length_sd_px=math.inf)
    return Survey((frame,), (camera,), LocalFrame(7.0, 51.0, 60.0), "EPSG:32632")


def test_a_survey_comes_back_equal() -> None:
    survey = a_survey()
    back = decode(encode(survey), Survey)
    assert back == survey
    assert isinstance(back.frames[0].position, Position)
    assert content_of(back) == content_of(survey)


def test_what_its_constructor_refuses_is_no_artefact() -> None:
    endless = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((2, 2)))
    object.__setattr__(endless, "up_m", np.array([[0.0, -np.inf], [0.0, 0.0]]))
    blind = a_survey()
    object.__setattr__(blind, "cameras", ())
    for broken in (endless, blind):
        with pytest.raises(FileError, match="no whole artefact"):
            decode(encode(broken), type(broken))


def test_a_whole_number_longer_than_any_array_has_is_no_figure() -> None:
    survey = a_survey()
    object.__setattr__(survey.frames[0].attitude, "roll_deg", 10**39)
    with pytest.raises(FileError, match="holds what"):
        decode(encode(survey), Survey)


def test_equal_content_has_one_fingerprint_forever() -> None:
    assert content_of((1, 2.5, "ö", None, np.array([[1, 2], [3, 4]], np.int16))) == (PINNED, {"ö"})
    column = np.asfortranarray(np.array([[1, 2], [3, 4]], np.int16))
    assert content_of((1, 2.5, "ö", None, column))[0] == PINNED
    assert content_of((1, 2.5, "ö", None, np.array([[1, 2], [3, 5]], np.int16)))[0] != PINNED
    assert content_of((1, 2.5)) != content_of([1, 2.5])


PINNED = "99aaa85d73dba78b19b09b90623d89e3e44fb0e3"


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([object()]), np.array(["2020"], "M8[D]"), math])
def test_what_has_no_plain_form_is_refused_by_its_place(value: Any) -> None:
    with pytest.raises(TypeError, match=r"^Outer\.more\['x'\]"):
        encode(Outer("a", (), {"x": value}))


def zipped(tree: Any, members: dict[str, bytes] | None = None, how: int = zipfile.ZIP_STORED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", how) as file:
        file.writestr("tree.json", json.dumps(tree))
        for name, data in (members or {}).items():
            file.writestr(name, data)
    return out.getvalue()


def npy(shape: str, descr: str = "<f8", body: bytes = bytes(16)) -> bytes:
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + body


def pickled() -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return file.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\x03\x04 no zip",
        pickle.dumps((1, 2)),
        zipped({"is": "os:system", "fields": {}}),
        zipped({"is": type_name(Camera), "fields": {}}),
        zipped({"is": type_name(Inner), "fields": []}),
        zipped({"dict": 3}),
        zipped({"is": type_name(Inner), "fields": {"xs": 1, "ys": 2}}),
        zipped({"tuple": [1] * 100_000}, how=zipfile.ZIP_DEFLATED),
        zipped({"array": 0}),
        zipped({"array": 0}, {"0": npy("(1000000000, 1000000000)")}),
        zipped({"array": 0}, {"0": npy("(3,)")}),
        zipped({"array": 0}, {"0": npy("(3,")}),
        zipped({"array": 0}, {"0": npy("3 3")}),
        zipped({"array": 0}, {"0": npy("(2,)", "|O")}),
        zipped({"array": 0}, {"0": pickled()}),
        zipped({"array": "../0"}),
        zipped({"what": 1}),
        zipped({"tuple": 1, "list": 2}),
        zipped([1, 2]),
        zipped(7),
        encode(Inner(np.zeros(3)))[:-30],
    ],
)
def test_foreign_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(FileError):
        decode(data, Inner)


def test_a_tree_that_is_too_deep_is_refused() -> None:
    tree = '{"tuple":[' * 5000 + "1" + "]}" * 5000
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        file.writestr("tree.json", tree)
    with pytest.raises(FileError):
        decode(out.getvalue(), tuple)


def test_the_right_handmade_file_is_taken() -> None:
    body = np.array([1.5, -2.0]).tobytes()
    data = zipped({"is": type_name(Inner), "fields": {"xs": {"array": 0}}}, {"0": npy("(2,)", body=body)})
    assert decode(data, Inner).xs.tolist() == [1.5, -2.0]


def test_a_field_added_later_with_a_default_is_read_from_old_files() -> None:
    @dataclass(frozen=True)
    class Old:
        name: str

    @dataclass(frozen=True)
    class New:
        name: str
        turned: tuple[int, ...] = (7,)

    @dataclass(frozen=True)
    class Stricter:
        name: str
        turned: tuple[int, ...]

    data = encode(Old("a"))
    for cls in (New, Stricter):
        cls.__qualname__, cls.__module__ = Old.__qualname__, Old.__module__
    assert decode(data, New) == New("a", (7,))
    with pytest.raises(FileError, match="no whole artefact"):
        decode(data, Stricter)


def test_a_field_of_another_type_is_no_artefact() -> None:
    """A forged file may have every hash right and a number where a name belongs."""
    good = RunFile("mosaic.tif", "00")
    assert decode(encode(good), RunFile) == good
    for name in (-1, None, ["mosaic.tif"], 3.5, True):
        with pytest.raises(FileError, match=r"holds what a .*RunFile doesn't"):
            decode(encode(RunFile(name, "00")), RunFile)  # type: ignore[arg-type]


def test_what_is_written_is_in_memory_once(tmp_path: Path) -> None:
    value = Outer("large", tuple(Inner(np.ones(1 << 20)) for _ in range(4)), {})
    with (tmp_path / "a").open("wb") as file:
        tracemalloc.start()
        write(value, file)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert most < 1 << 20
    assert (tmp_path / "a").read_bytes() == encode(value)


def test_artefacts_of_earlier_versions_are_read_by_the_former_names_of_their_classes() -> None:
    grid = OutputGrid("EPSG:32632", 500_000.0, 5_000_000.0, 0.1, 30, 20)
    former = with_texts(
        encode(grid), lambda text: text.replace("geomosaic.composition.", "geomosaic.mosaic.")
    )
    assert b"geomosaic.mosaic.model:OutputGrid" in former
    assert decode(former, OutputGrid) == grid
    assert present_name("geomosaic.surface.terrain:TerrainModel") == type_name(TerrainModel)
