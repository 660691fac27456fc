"""The model of parts that move, from noisy poses."""
