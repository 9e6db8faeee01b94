"""Domain randomization: every episode has a world of its own (paper Sec. V-C)."""
