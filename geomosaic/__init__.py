"""geomosaic: overlapping images of the ground in, one map-true image out."""

__version__ = "0.1.0"

from geomosaic.doors.offline import go_offline

go_offline()
