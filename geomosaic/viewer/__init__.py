"""A finished run in a browser: its map at full size, with what can be measured on it."""
