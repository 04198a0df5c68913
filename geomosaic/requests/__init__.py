"""What a run is asked for: one frozen request that the command line, Python and QGIS fill."""
