"""The hot equations: collinearity, normal equations, nested dissection."""
