"""Error sharing and its rivals, global least squares: from tie points to adjusted poses."""
