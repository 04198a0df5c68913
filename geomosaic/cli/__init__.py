"""The command line: knows the registry and nothing below it."""
