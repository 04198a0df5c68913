"""The page for people: what a run found, in words, tables, plots and pictures; of frames and of strips."""
