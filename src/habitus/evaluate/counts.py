"""How many shape coefficients bodies are measured with."""

COUNTS = (1, 2, 5, 10, 20, 50, 100)
"""Numbers of shape coefficients that errors are reported for, as far as a model has them."""
