"""How files of strangers come in: budgets of size, depth and time, and from elsewhere one door alone."""
