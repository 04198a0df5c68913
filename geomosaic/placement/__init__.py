"""Nadir points on the map, flight lines, the overlap graph, candidate pairs."""
