"""geomosaic: overlapping pictures of the ground in, one map-true picture out."""

__version__ = "0.1.0"
