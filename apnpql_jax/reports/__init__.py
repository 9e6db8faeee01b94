"""Reports of finished and unfinished runs; none of this imports JAX."""
