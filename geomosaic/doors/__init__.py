"""How files of strangers come in: with a budget of size, depth and time, local, and as what they say they are."""
