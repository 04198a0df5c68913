"""A recorded run again: its artefacts, and frames that lie moved_frames or are gone."""
