"""MuJoCo and nothing of learning."""

from apnpql_jax import runtime

with runtime.quiet_warp():
  import mujoco.mjx  # noqa: F401 - its first import prints about the optional Warp
