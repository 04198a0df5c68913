"""Enhancement, SIFT, guided search, geometric check, consensus: from images to tie points."""
