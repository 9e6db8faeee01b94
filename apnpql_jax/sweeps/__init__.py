"""Sweeps: many runs of one plan, on one machine or a cluster; nothing imports JAX."""
