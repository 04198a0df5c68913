"""The bundle method, step by step."""
