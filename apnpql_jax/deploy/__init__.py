"""Trained policies outside of the simulation: export and its contract."""
