"""The paper's error sharing and its rivals, which slide frames over the map."""
