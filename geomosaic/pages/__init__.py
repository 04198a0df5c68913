"""Pages in a browser of this machine: their server on loopback, and what they have in common."""
