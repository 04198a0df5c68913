"""How files of strangers come in: with budgets of size, depth and time, and nothing remote."""
