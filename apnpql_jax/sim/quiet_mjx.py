"""MJX, imported nowhere else, without what its import prints about optional Warp."""

from apnpql_jax import runtime

with runtime.quiet_warp():
  from mujoco import mjx  # noqa: F401 - for the other modules
