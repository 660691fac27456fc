"""``stream``: a door that a hand opens, tracked at 30 Hz with correlated errors and outliers."""
