"""The virtual arm in contact with walls: stable where predicted, and only there."""

from __future__ import annotations

from contact import FILTER_S, stiffness_limit
import numpy as np
import pytest
from rigs import NEUTRAL

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.sensor import FREE_FORCE, load
from apnpql_jax.robot.virtual_arm import Admittance, VirtualArm, ramp
from apnpql_jax.sim.motors import VELOCITY_GAIN

MODEL = ArmModel()
UP = np.array([0.0, 0.0, 1.0])
STILL = MODEL.dynamics(NEUTRAL, np.zeros(6))
KICK = 0.05  # N, of the disturbance
NEAR = 0.1  # Relative distance from the predicted limit that the sweep leaves out.


def wrench_at_tool(way: np.ndarray) -> np.ndarray:
  """Returns the wrench f64[6] of 1 N on the tool along a direction of the world."""
  flange, _ = MODEL.flange_pose(NEUTRAL)
  torque = np.cross(MODEL.tool_position(NEUTRAL) - flange, way)
  return np.concatenate([MODEL.base_mat.T @ way, MODEL.base_mat.T @ torque])


def swing(
  stiffness: float,
  lag: float,
  admittance: Admittance,
  seconds: float,
  share: float,
  way: np.ndarray,
) -> float:
  """Returns the swing of the force (N) at the end, after a small disturbance.

  A linear wall pushes the tool along ``way``, and the policy presses just so much that
  it rests where the damping has its ``share``.
  """
  arm = VirtualArm(MODEL, admittance=admittance)
  arm.reset(NEUTRAL)
  unit = wrench_at_tool(way)
  rest = (1 + share) / load(unit)
  arm._wrench = rest * unit  # As after a long time of contact.
  felt = rest * ramp(1 + share)[1]
  desired = -np.linalg.solve(STILL.mass, STILL.tool[:3].T @ way) * felt / VELOCITY_GAIN
  assert np.abs(VELOCITY_GAIN * desired).max() < 1.2
  place = MODEL.tool_position(NEUTRAL)
  moved, forces = [0.0] * (1 + round(lag / TIMESTEP)), []
  for cycle in range(round(seconds / TIMESTEP)):
    kick = KICK if cycle < 5 else 0.0
    forces.append(rest + kick - stiffness * moved[0])
    advance(arm, desired, forces[-1] * unit)
    moved = [*moved[1:], (MODEL.tool_position(arm.position) - place) @ way]
  return np.ptp(forces[-round(0.5 / TIMESTEP) :])


def advance(arm: VirtualArm, desired: np.ndarray, wrench: np.ndarray) -> None:
  """Steps the arm as the core does, which leaves out the lead."""
  before = arm.position
  arm.step(desired, None, wrench)
  arm.synchronize(before + TIMESTEP * arm.velocity, arm.velocity)


def check(
  stiffness: float,
  lag: float,
  admittance: Admittance,
  share: float,
  way: np.ndarray = UP,
) -> bool | None:
  """Compares motion and prediction; returns which, or None near the limit."""
  limit = stiffness_limit(STILL, way, admittance, lag, share=share)
  if abs(stiffness / limit - 1) < NEAR:
    return None
  stable = bool(stiffness < limit)
  found = swing(stiffness, lag, admittance, 4.0, share, way)
  assert (found < KICK) == stable, (stiffness, lag, share, found, limit)
  return stable


@pytest.mark.parametrize("lag", [0.002, 0.01, 0.03, 0.06])
def test_stable_walls_are_the_predicted_ones(lag):
  outcomes = [check(k, lag, Admittance(), 0.4) for k in (1e3, 1e4, 5e4)]
  assert True in outcomes and (False in outcomes or lag < 0.02)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.7])
def test_contacts_at_the_edge_of_the_dead_zone_are_stable_where_predicted(share):
  outcomes = [
    check(k, lag, Admittance(), share) for k in (1e4, 5e4) for lag in (0.03, 0.06)
  ]
  assert True in outcomes and (False in outcomes or share < 0.1)


@pytest.mark.parametrize("way", [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
def test_contacts_whose_torque_counts_are_stable_where_predicted(way):
  """Forces across the hand: their torque on the flange is the first to be felt."""
  outcomes = [
    check(k, lag, Admittance(), 0.4, np.array(way))
    for k in (1e4, 5e4)
    for lag in (0.01, 0.06)
  ]
  assert True in outcomes and False in outcomes


@pytest.mark.slow
@pytest.mark.parametrize("damping_for", [2e3, 1e4, 3e4])
def test_stable_walls_are_the_predicted_ones_everywhere(damping_for):
  outcomes = [
    check(k, lag, Admittance(stiffness=damping_for), share)
    for share in (0.1, 0.7)
    for k in np.geomspace(1e3, 5e4, 10)
    for lag in (0.002, 0.006, 0.01, 0.016, 0.024, 0.034, 0.046, 0.06)
  ]
  assert outcomes.count(True) > 10
  assert outcomes.count(False) > 3 or damping_for > 1e4  # D_c bears all walls.


def test_the_designed_stiffness_is_stable_without_the_motors():
  """D_c = 1.5 k tau alone, whatever the mass: poses, directions, and lags up to tau."""
  rng, admittance = np.random.default_rng(0), Admittance()
  for _ in range(20):
    pose = NEUTRAL + rng.uniform(-0.5, 0.5, 6)
    dynamics = MODEL.dynamics(pose, np.zeros(6))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    lag = rng.uniform(0.0, admittance.lag - FILTER_S)
    share = rng.uniform(0.01, 1.0)  # Of the damping, and of the felt stiffness.
    limit = stiffness_limit(
      dynamics, direction, admittance, lag, share=share, saturated=True
    )
    assert limit > 1.5 * admittance.stiffness
    assert limit > admittance.damping / (lag + FILTER_S)


def test_without_damping_a_soft_wall_is_unstable():
  """The lag that a position-controlled arm has makes D_c necessary."""
  soft = Admittance(stiffness=1.0)
  assert stiffness_limit(STILL, UP, soft, 0.03) < 5_000
  assert check(1e4, 0.03, soft, 0.7) is False


def hit(stiffness: float, lag: float) -> list[float]:
  """Returns the forces (N) as the tool comes down on a wall at 0.1 m/s, and stays."""
  arm = VirtualArm(MODEL, admittance=Admittance())
  arm.reset(NEUTRAL)
  wall = MODEL.tool_position(NEUTRAL)[2] - 0.02
  desired = -0.1 * np.linalg.solve(STILL.tool, np.append(UP, np.zeros(3)))
  heights, forces = [np.inf] * (1 + round(lag / TIMESTEP)), []
  for _ in range(round(3.0 / TIMESTEP)):
    forces.append(max(0.0, stiffness * (wall - heights[0])))
    advance(arm, desired, np.append(forces[-1] * UP, np.zeros(3)))
    heights = [*heights[1:], MODEL.tool_position(arm.position)[2]]
  return forces


@pytest.mark.parametrize("lag", [0.01, 0.035])
@pytest.mark.parametrize("stiffness", [1e3, 1e4])
def test_a_hit_on_a_wall_of_the_designed_stiffness_comes_to_rest(stiffness, lag):
  """It may bounce, and then presses without buzzing."""
  forces = hit(stiffness, lag)
  assert max(forces) > 2 * FREE_FORCE or stiffness < 2e3  # It has felt all of it.
  assert np.ptp(forces[-round(0.5 / TIMESTEP) :]) < 0.2
  assert FREE_FORCE < forces[-1] < 3 * FREE_FORCE


def test_a_hit_on_a_stiffer_wall_may_go_on_bouncing():
  """The analysis is linear, with a wall that also pulls."""
  forces = hit(1.5e4, 0.035)
  assert np.ptp(forces[-round(0.5 / TIMESTEP) :]) > FREE_FORCE
