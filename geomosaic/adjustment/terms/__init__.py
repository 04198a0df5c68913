"""One file a physical statement."""
