"""Run folders and what lies in them: checkpoints, metrics, locks."""
