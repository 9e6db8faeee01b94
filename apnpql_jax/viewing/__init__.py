"""Watching an agent: one played world, shown in a browser or written as a video."""
