"""What is special to the strips of staggered CCDs: overlaps, offsets line by line, radiometry."""
