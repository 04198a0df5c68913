"""A recording in Rerun, afterwards or while it grows."""
