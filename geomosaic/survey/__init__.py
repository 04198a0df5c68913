"""The nouns and the front door: frames, POS, cameras, DEM, control; reads EXIF, XMP, CSV."""
