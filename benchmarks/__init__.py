"""Measurements of speed, quality and reliability; README.md lists them."""
