"""The surface that frames show between and above their tie points, matched on the verticals of its cells."""
