"""Motion checks: every joint is moved through its range, and what cannot be right is said."""
