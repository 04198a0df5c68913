"""How hazy frames are: an example of a stage of one's own."""
