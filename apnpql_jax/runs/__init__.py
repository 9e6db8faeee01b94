"""Run folders and their contents: checkpoints, metrics, locks."""
