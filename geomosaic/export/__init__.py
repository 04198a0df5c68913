"""COG, GeoPackage, positions, tiles, report: what people take away."""
