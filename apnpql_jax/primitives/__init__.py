"""Action primitives: joint targets, reset states, following."""
