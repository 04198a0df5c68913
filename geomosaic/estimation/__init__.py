"""Mathematics that every room shares: linear systems, without photogrammetry."""
