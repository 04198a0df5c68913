"""The page for people: what a run found, in words, tables, plots and images; of frames and of strips."""
