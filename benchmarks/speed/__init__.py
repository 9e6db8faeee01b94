"""Speed of the parts of the project and of a whole training."""

from apnpql_jax import sim as _sim  # noqa: F401 - imports MJX without its output
