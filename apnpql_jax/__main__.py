"""The command ``apnpql`` as ``python -m apnpql_jax``."""

from __future__ import annotations

import sys

from apnpql_jax.cli.main import main

if __name__ == "__main__":
  sys.exit(main())
