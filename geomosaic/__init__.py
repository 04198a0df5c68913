"""geomosaic: overlapping images of the ground in, one map-true image out.

import geomosaic as gm
run = gm.mosaic("frames/", "out/")
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from geomosaic.doors.offline import go_offline

__version__ = "0.1.0"
_FUNCTIONS = ("Judgement", "Run", "mosaic", "open_run", "replay", "run", "stages", "strips")
"""What `geomosaic.runs` has and people call by this module's name; imported when it is first asked for."""

go_offline()


class _Callable(ModuleType):
    """A room that has a function's name, and is that function too: `gm.mosaic("frames/")`."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        function = getattr(import_module("geomosaic.runs"), self.__name__.rpartition(".")[2])
        return function(*arguments, **options)


class _Package(ModuleType):
    """Where a room has a function's name, Python's import puts the room there; it is made callable."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _FUNCTIONS and isinstance(value, ModuleType):
            value.__class__ = _Callable
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name in _FUNCTIONS:
            return getattr(import_module("geomosaic.runs"), name)
        raise AttributeError(f"module 'geomosaic' has no attribute '{name}'")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *_FUNCTIONS]


sys.modules[__name__].__class__ = _Package
