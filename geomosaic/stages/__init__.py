"""One thin file per stage: adapt, call the rooms, return."""
