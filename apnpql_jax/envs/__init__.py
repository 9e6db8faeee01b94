"""Batches of worlds: states, cameras, reset and step."""
