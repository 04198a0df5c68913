"""For installations that announce the simulator's stages here; `make setup` renews them."""

from geomosaic_simulate.stage_strips import SimulateStrips

__all__ = ["SimulateStrips"]
