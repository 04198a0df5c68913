"""The surface between and above the tie points, matched by a plane sweep along the verticals of its cells."""
