"""Settings shared by all tests."""

from __future__ import annotations

import os

import apnpql_jax  # noqa: F401  (sets threads and the compilation cache)

# Figures are written to files; no test may need a display.
os.environ.setdefault("MPLBACKEND", "Agg")
