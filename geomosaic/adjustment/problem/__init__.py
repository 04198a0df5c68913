"""A block as the solver takes it."""
