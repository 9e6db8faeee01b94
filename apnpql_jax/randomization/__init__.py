"""Domain randomization: every episode has its own world (paper Sec. V-C)."""
