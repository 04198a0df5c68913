"""One curve for the whole map."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest
import rasterio
from mosaic_scenes import make_survey
from small_surveys import MAP_ALONE, made_map, small_survey

from geomosaic.composition.tone_curve import curve_to_mid_grey, curved, how_dark, median_grey
from geomosaic.composition.tones import Tones, ToneSightings
from geomosaic.errors import InputError
from geomosaic.pipeline.stage import Context
from geomosaic.stages.mosaic_tones import mosaic_tones

EVENED = (*MAP_ALONE[:5], "mosaic.tones", *MAP_ALONE[5:])
GREY = np.arange(256, dtype=np.uint8).reshape(1, 256, 1)


def of_two_frames(grey: float, gain: float = 0.0) -> tuple[Tones, ToneSightings, np.ndarray]:
    """Two frames, the second brighter by a gain, that show 40 places about one grey level."""
    ground = grey * np.exp(np.linspace(-0.3, 0.3, 40))
    frame = np.repeat([0, 1], 40)
    values = np.concatenate([ground, ground * np.exp(gain)])[:, None].astype(np.float32)
    nodes = np.column_stack([np.arange(40), np.zeros(40, int)])
    places = ToneSightings(np.tile(np.arange(40), 2), frame, np.zeros((80, 2)), np.zeros((80, 2)), nodes)
    nothing = np.zeros((2, 1, 2))
    return Tones(np.array([[0.0], [gain]]), nothing, nothing), places, values


def test_half_of_the_map_becomes_darker_than_mid_grey() -> None:
    """What frames differ by is taken off first: their gains do not brighten the map."""
    for gain in (0.0, 0.8):
        tones, places, values = of_two_frames(60.0, gain)
        grey = median_grey(tones, places, values)
        assert grey == pytest.approx(60.0, rel=0.01)
        curve = curve_to_mid_grey(grey)
        assert curve == pytest.approx(118 / 137 / (60 / 195), rel=0.02)
        assert curved(np.full((1, 1, 3), 60, np.uint8), curve).ravel().tolist() == [118, 118, 118]


def test_the_curve_is_gentle() -> None:
    assert [curve_to_mid_grey(grey) for grey in (0.0, 8.0, 255.0, float("nan"))] == [4.0, 4.0, 0.25, 1.0]
    assert curve_to_mid_grey(190.0) == pytest.approx(118 / 137 / (190 / 65))
    tones, places, values = of_two_frames(60.0)
    assert np.isnan(median_grey(tones, places, np.full_like(values, np.nan)))
    assert [how_dark(grey) for grey in (60.0, 80.0, 118.0, 155.0, 175.0, float("nan"))] == [
        "dark", "", "", "", "pale", "",
    ]  # fmt: skip


@pytest.mark.parametrize("curve", [0.25, 0.7, 1.0, 2.0, 4.0])
def test_black_and_white_stay_and_values_keep_their_order(curve: float) -> None:
    found = curved(GREY, curve).ravel().astype(int)
    assert (found[0], found[255]) == (0, 255) and (np.diff(found) >= 0).all()
    wanted = 255.0 / (1.0 + (255.0 - GREY[0, 1:, 0]) / (curve * GREY[0, 1:, 0]))
    np.testing.assert_allclose(found[1:], wanted, atol=0.51)


def test_a_mosaic_is_brightened_from_edge_to_edge(tmp_path: Path) -> None:
    made = small_survey(tmp_path / "flight", exposure_sd=0.1)
    plain, bright = tmp_path / "plain", tmp_path / "bright"
    assert "curve" not in made_map(made, plain, EVENED)["metrics"]["tones"]
    found = made_map(made, bright, EVENED, mosaic__tones={"brighten": True})
    with rasterio.open(plain / "mosaic.tif") as one, rasterio.open(bright / "mosaic.tif") as other:
        before, after, valid = one.read([1, 2, 3]), other.read([1, 2, 3]), one.dataset_mask() > 0
        assert (valid == (other.dataset_mask() > 0)).all()
    wanted = curved(np.ascontiguousarray(before), found["metrics"]["tones"]["curve"])
    off = np.abs(after.astype(int) - wanted)[:, valid]
    assert np.mean(off <= 2) > 0.95, "the same curve everywhere, but for the blend of seams"
    assert abs(float(np.median(after[:, valid])) - 118.0) < 12.0
    assert abs(float(np.median(before[:, valid])) - 118.0) > 12.0


@pytest.mark.parametrize(
    ("grey", "said"),
    [
        (70.0, "dark: half of the map is darker than 70 of 255; --brighten makes that 118"),
        (8.0, "dark: half of the map is darker than 8 of 255; --brighten makes that 29"),
        (200.0, "pale: half of the map is darker than 200 of 255; --brighten makes that 121"),
        (100.0, None),
        (None, None),
    ],
)
def test_a_run_says_that_its_map_is_dark_or_pale(grey: float | None, said: str | None) -> None:
    wanted = [] if said is None else [("brightness", said)]
    assert mosaic_tones.conclusions({"metrics": {"tones": {"median_grey": grey}}}) == wanted
    assert mosaic_tones.conclusions({"metrics": {"tones": {"median_grey": grey, "curve": 2.0}}}) == []
    assert mosaic_tones.conclusions({"metrics": {}}) == []


def test_measured_values_are_not_brightened(tmp_path: Path) -> None:
    survey, *_ = make_survey(tmp_path, lines=1, per_line=2, dtype="uint16")
    asked = {"survey": survey, "ground": None, "adjusted": None}
    with pytest.raises(InputError, match=r"leave out --brighten"):
        mosaic_tones().run(asked, mosaic_tones.Params(brighten=True), cast(Context, None))
