"""What is wrong in a run, and what differs between two: figures, tables, pictures."""
