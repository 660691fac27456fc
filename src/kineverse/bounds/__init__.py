"""Between which numbers an expression lies: its graph, step by step, and interval arithmetic on it."""
