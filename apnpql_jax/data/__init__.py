"""Transitions and demonstrations, in memory and on disk."""
