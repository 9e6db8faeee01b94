"""Benchmarks of a GPU under a time budget."""
