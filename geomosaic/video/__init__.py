"""Frames out of a drone's video, with the positions of its subtitles."""
