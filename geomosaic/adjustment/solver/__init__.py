"""Normal equations, steps, variance components, covariance."""
