"""Inverse kinematics on the host, with mink.

Worker processes import this module, so it imports no JAX code of the package.
"""

from __future__ import annotations

import mink
import mujoco
import numpy as np

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.sim.names import TOOL_SITE

MAX_ITERATIONS = 60
POSITION_TOLERANCE = 1e-3  # m; a target with a larger residual counts as unreachable
ROTATION_TOLERANCE = np.deg2rad(0.5)  # rad; likewise
MAX_STEP = 0.3  # rad; longest step of a joint in one iteration
# Against position and orientation costs of 1: it decides only the null space and, at
# unreachable poses, keeps the arm near its start.
POSTURE_COST = 1e-4


class IkSolver:
  """Differential IK of the robot's tool site with posture and joint limits."""

  def __init__(self):
    model = mujoco.MjModel.from_xml_path(str(mjcf_path("robot")))
    self._configuration = mink.Configuration(model)
    self._pose = mink.FrameTask(
      TOOL_SITE, "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6
    )
    self._posture = mink.PostureTask(model, cost=POSTURE_COST)
    self._limits = [mink.ConfigurationLimit(model)]

  def solve(
    self, start: np.ndarray, pos: np.ndarray, mat: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray]:
    """Finds the configuration nearest to ``start`` that puts the tool at a world pose.

    Returns the configuration f64[6] (rad) and the residuals f64[2] (m and rad).
    """
    configuration = self._configuration
    q = np.zeros(configuration.model.nq)
    q[: len(start)] = start
    configuration.update(q)
    self._posture.set_target(q)
    rotation = mink.SO3.from_matrix(np.asarray(mat, np.float64))
    self._pose.set_target(
      mink.SE3.from_rotation_and_translation(rotation, np.asarray(pos, np.float64))
    )
    residuals = np.zeros(2)
    for _ in range(MAX_ITERATIONS):
      error = self._pose.compute_error(configuration)
      residuals[:] = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
      if residuals[0] < 1e-5 and residuals[1] < 1e-4:
        break
      # A unit step with a unit time constant: one Gauss-Newton step per iteration.
      tasks = [self._pose, self._posture]
      velocity = mink.solve_ik(
        configuration, tasks, 1.0, solver="daqp", damping=1e-9, limits=self._limits
      )
      # Longer steps could reach another branch of the arm's configurations.
      longest = max(float(np.abs(velocity).max()), 1e-9)
      configuration.integrate_inplace(velocity, min(1.0, MAX_STEP / longest))
    return configuration.q[: len(start)].copy(), residuals


def solve_all(
  starts: np.ndarray, positions: np.ndarray, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Solves k targets for each of n states in this process.

  Returns targets f64[n, k, 6] (rad) and residuals f64[n, k, 2] (m and rad).
  """
  solver = IkSolver()
  solved = [
    solver.solve(start, *pose)
    for start, *poses in zip(starts, positions, rotations, strict=True)
    for pose in zip(*poses, strict=True)
  ]
  q, residuals = map(np.array, zip(*solved, strict=True))
  batch = positions.shape[:2]
  return q.reshape(*batch, -1), residuals.reshape(*batch, -1)
