"""Enhancement, SIFT, guided search, geometric check, consensus: from pictures to tie points."""
