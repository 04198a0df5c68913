"""MCAP writer and reader, replay, diff, the Rerun view: beside the staircase, not on it."""
