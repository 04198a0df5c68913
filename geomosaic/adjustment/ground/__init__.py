"""The ground that goes with a solved block."""
