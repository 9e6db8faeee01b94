"""Physics on top of MuJoCo: scenes, engines and kinematics; no learning code."""

from apnpql_jax import runtime

with runtime.quiet_warp():
  import mujoco.mjx  # noqa: F401 - the first import prints about the optional Warp
