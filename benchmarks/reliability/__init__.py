"""Training runs that are interrupted, damaged and resumed."""
