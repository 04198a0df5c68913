"""Indices of a mosaic's bands, such as NDVI: a formula of their names, pixel by pixel."""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from osgeo import gdal
from rasterio.enums import ColorInterp
from rasterio.windows import Window

from geomosaic.arrays import Floats32
from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.doors.raster import OWN, Raster, open_raster, open_with_osgeo, reading
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.export.surface import NODATA
from geomosaic.export.surface_heights import describe_bands
from geomosaic.radiometry.quantity import TEMPERATURE, UNCALIBRATED, quantity_of

FORMULAS: Final = {
    "NDVI": "(nir - red) / (nir + red)",
    "NDRE": "(nir - rededge) / (nir + rededge)",
    "GNDVI": "(nir - green) / (nir + green)",
    "GLI": "(2 * green - red - blue) / (2 * green + red + blue)",
}
"""Rouse et al. 1974; Barnes et al. 2000; Gitelson et al. 1996; Louhaichi et al. 2001."""
AUTO: Final = "auto"
USUAL: Final = (-0.2, 1.0)
"""The ends of the colours of indices with near infrared: water to dense leaves."""
_SHORT: Final = {"g": "green", "gre": "green", "r": "red", "b": "blue", "re": "rededge", "reg": "rededge"}
"""Band names of Parrot's and DJI's files, as formulas have them."""
_OPERATORS: Final[Mapping[type, Callable[..., Any]]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip
_FUNCTIONS: Final[Mapping[str, Callable[..., Any]]] = {"sqrt": np.sqrt, "abs": np.abs}
_LIKE: Final = "write it like (nir - red) / (nir + red)"
_LONGEST: Final = 300
_ROWS: Final = 512
_SAMPLED_PX: Final = 2000
_OPTIONS: Final = ["TILED=YES", "COMPRESS=DEFLATE", "BIGTIFF=IF_SAFER"]


@dataclass(frozen=True)
class Index:
    """A formula, its name, and the syntax tree that it was parsed to."""

    name: str
    formula: str
    tree: ast.expr

    @classmethod
    def of(cls, formula: str, name: str | None = None) -> Index:
        """An index of `FORMULAS`, or a formula of band names, numbers, + - * / **, sqrt and abs.

        Raises: `InputError` for another formula; nothing in it is executed.
        """
        known = formula.strip().upper()
        text = FORMULAS.get(known, formula)
        if len(text) > _LONGEST:
            raise InputError(f"the formula has more than {_LONGEST} characters", fix="give a shorter one")
        try:
            tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise InputError(f"'{text}' is no formula", fix=_LIKE) from error
        _check(tree, text)
        if not any(isinstance(n, ast.Name) for n in ast.walk(tree)):
            raise InputError(f"'{text}' names no band", fix=_LIKE)
        label = name or (known if known in FORMULAS else "index")
        if not re.fullmatch(r"[\w-]{1,40}", label):
            raise InputError(f"'{label}' is no name for a file", fix="use letters, digits, - and _")
        return cls(label, text, tree)

    @classmethod
    def for_mosaic(cls, mosaic: Path, formula: str, name: str | None = None) -> Index:
        """As `of`; auto: NDVI, without a near-infrared band GLI; temperature: the thermal band."""
        if formula not in (AUTO, TEMPERATURE):
            return cls.of(formula, name)
        with open_raster(mosaic, OWN) as raster:
            there = _numbers(raster)
            meant = {band: quantity_of(raster, k) for band, k in there.items()}
        if formula == AUTO:
            return cls.of("NDVI" if "nir" in there else "GLI", name)
        for band, quantity in meant.items():
            if quantity is not None and quantity.name == TEMPERATURE:
                return cls.of(band, name or TEMPERATURE)
        fix = "mosaic frames whose values are degrees, in 32-bit floats"
        raise InputError("no band holds temperatures", file=mosaic, fix=fix)

    @property
    def bands(self) -> list[str]:
        """The band names in the formula."""
        called = {n.func for n in ast.walk(self.tree) if isinstance(n, ast.Call)}
        found = [n.id for n in ast.walk(self.tree) if isinstance(n, ast.Name) and n not in called]
        return sorted({band_key(name) for name in found})

    def values(self, bands: Mapping[str, Floats32]) -> Floats32:
        """Of each band's physical values; not finite where the formula has no value."""
        with np.errstate(all="ignore"):
            return np.asarray(_value(self.tree, bands), dtype=np.float32)


def _check(node: ast.expr, text: str) -> None:
    match node:
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            _check(left, text)
            _check(right, text)
        case ast.UnaryOp(op=op, operand=inner) if type(op) in _OPERATORS:
            _check(inner, text)
        case ast.Call(func=ast.Name(id=name), args=[inner], keywords=[]) if name in _FUNCTIONS:
            _check(inner, text)
        case ast.Name() | ast.Constant(value=int() | float()):
            pass
        case _:
            problem = f"'{text}' holds more than band names, numbers, + - * / **, sqrt and abs"
            raise InputError(problem, fix=_LIKE)


def _value(node: ast.expr, bands: Mapping[str, Floats32]) -> Any:
    match node:
        case ast.BinOp(left=left, op=op, right=right):
            return _OPERATORS[type(op)](_value(left, bands), _value(right, bands))
        case ast.UnaryOp(op=op, operand=inner):
            return _OPERATORS[type(op)](_value(inner, bands))
        case ast.Call(func=ast.Name(id=name), args=[inner]):
            return _FUNCTIONS[name](_value(inner, bands))
        case ast.Name(id=name):
            return bands[band_key(name)]
        case ast.Constant(value=number):
            return np.float32(number)  # type: ignore[arg-type]
    raise AssertionError(node)


def band_key(name: str) -> str:
    """A band's name as formulas have it: `Red edge` is rededge."""
    bare = re.sub(r"[^0-9a-z]", "", name.lower())
    return _SHORT.get(bare, bare)


@dataclass(frozen=True)
class MosaicBands:
    """A mosaic's bands by their names in formulas; what the values of those in use are; the index's unit."""

    raster: Raster
    numbers: Mapping[str, int]
    values: str
    unit: str

    @classmethod
    def of(cls, raster: Raster, index: Index) -> MosaicBands:
        """Those that an index wants. Raises: `UnknownNameError` for a band that is not there."""
        there = _numbers(raster)
        for name in index.bands:
            if name not in there:
                raise UnknownNameError("band", name, there, file=raster.name)
        numbers = {name: there[name] for name in index.bands}
        meant = [quantity_of(raster, k) or UNCALIBRATED for k in numbers.values()]
        by = {f"{q.name} by {q.source}" if q.source else q.name for q in meant}
        unit = meant[0].unit if isinstance(index.tree, ast.Name) else ""
        return cls(raster, numbers, " and ".join(sorted(by)), unit)

    def read(self, window: Window) -> dict[str, Floats32]:
        """Physical values (rows, cols) by band, NaN where the mosaic shows nothing."""
        valid = self.raster.dataset_mask(window=window) > 0
        found = {}
        for name, k in self.numbers.items():
            values = self.raster.read(k, window=window).astype(np.float32)
            scaled = values * np.float32(self.raster.scales[k - 1]) + np.float32(self.raster.offsets[k - 1])
            found[name] = np.where(valid, scaled, np.float32(np.nan))
        return found


def _numbers(raster: Raster) -> dict[str, int]:
    """Of a mosaic's bands, by their names in formulas."""
    colours = zip(raster.descriptions, raster.colorinterp, strict=True)
    names = [name or colour.name for name, colour in colours if colour != ColorInterp.alpha]
    return {band_key(name): k for k, name in enumerate(names, start=1)}


def write_index(mosaic: Path, out: Path, index: Index, done: Callable[[int, int], None]) -> str:
    """Writes an index as a plain raster in 32-bit floats; gives what values it is of.

    Args: done: called with rows done and all. Raises: `OSError` where it can't be written.
    """
    with open_raster(mosaic, OWN) as raster, reading(mosaic, OWN.problem, OWN.fix), gdal_failures(out):
        bands = MosaicBands.of(raster, index)
        source = open_with_osgeo(mosaic, OWN)
        size = raster.width, raster.height
        made = gdal.GetDriverByName("GTiff").Create(str(out), *size, 1, gdal.GDT_Float32, _OPTIONS)
        made.SetSpatialRef(source.GetSpatialRef())
        made.SetGeoTransform(source.GetGeoTransform())
        made.SetMetadata({"FORMULA": index.formula, "VALUES": bands.values})
        describe_bands(made, [(index.name, bands.unit)], NODATA)
        for row in range(0, raster.height, _ROWS):
            done(row, raster.height)
            window = Window(0, row, raster.width, min(_ROWS, raster.height - row))
            values = index.values(bands.read(window))
            known = np.where(np.isfinite(values), values, np.float32(NODATA))
            made.GetRasterBand(1).WriteArray(known, 0, row)
        close(made)
        del source
        return bands.values


def index_ends(raster: Path) -> tuple[float, float]:
    """What the first and the last colour of an index's raster stand for: `USUAL`, or the 2nd and the 98th
    percentile of another formula's values."""
    with open_raster(raster, OWN) as tiff:
        if (formula := tiff.tags().get("FORMULA")) in FORMULAS.values() and "nir" in formula:
            return USUAL
        step = max(1, max(tiff.shape) // _SAMPLED_PX)
        values = tiff.read(1, out_shape=(-(-tiff.height // step), -(-tiff.width // step)), masked=True)
    known = values.compressed()
    low, high = np.percentile(known, (2.0, 98.0)).tolist() if known.size else (0.0, 1.0)
    return low, high if high > low else low + 1.0
