"""For installations that announce the simulator's stages here; `make setup` renews them."""

from geomosaic_simulate.stage_frames import SimulateFrames

__all__ = ["SimulateFrames"]
