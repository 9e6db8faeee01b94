"""The virtual arm moves as training's arm, and answers contacts as predicted."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from rigs import NEUTRAL

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.robot.limits import DEVIATION
from apnpql_jax.robot.sensor import FORCE_ACCURACY, TORQUE_ACCURACY, Sensor, load
from apnpql_jax.robot.virtual_arm import Admittance, VirtualArm, ramp
from apnpql_jax.sim import motors

PERIODS = 20


def trained(actions: np.ndarray) -> np.ndarray:
  """Returns joint angles after each period of 0.15 s of training's arm, in C MuJoCo."""
  model = mujoco.MjModel.from_xml_path(str(mjcf_path("push_plate")))
  data = mujoco.MjData(model)
  data.qpos[:] = model.keyframe("neutral").qpos
  limit, found = model.actuator_ctrlrange[:6, 1], []
  for action in actions:
    for _ in range(30):
      mujoco.mj_forward(model, data)
      mass = np.zeros((model.nv, model.nv))
      mujoco.mj_fullM(model, data, mass)
      bias, velocity = data.qfrc_bias[:6], data.qvel[:6]
      data.ctrl[:6] = motors.arm_torque(mass[:6, :6], bias, velocity, action[:6], limit)
      data.ctrl[6] = motors.gripper_torque(data.qpos[6], data.qvel[6], 1.0, np)
      mujoco.mj_step(model, data)
    found.append(data.qpos[:6].copy())
  return np.array(found)


@pytest.mark.parametrize("seed", range(3))
def test_moves_as_in_training(seed):
  actions = np.random.default_rng(seed).uniform(-1, 1, (PERIODS, 6))
  arm, found = VirtualArm(), []
  arm.reset(NEUTRAL)
  for action in actions:
    for _ in range(75):
      arm.step(action)
    found.append(arm.position)
  error = np.abs(np.array(found) - trained(actions)).max()
  print(error)
  assert error <= 1e-3
  assert np.abs(found[-1] - NEUTRAL).max() > 0.1


def test_small_forces_and_no_admittance_change_nothing():
  for admittance, force in ((Admittance(), 7.4), (None, 40.0)):
    arm = VirtualArm(admittance=admittance)
    arm.reset(NEUTRAL)
    for _ in range(500):
      arm.step(np.zeros(6), NEUTRAL, np.array([0, 0, force, 0, 0, 0.59]))
    np.testing.assert_allclose(arm.position, NEUTRAL, atol=1e-6)
    assert arm.share == 0.0


def speed(sensor: Sensor | None = None, bias: float | np.ndarray = 0.0) -> np.ndarray:
  """Returns the joint velocities f64[6] of a free arm after 1.2 s of full speed."""
  arm = VirtualArm(admittance=Admittance())
  arm.reset(NEUTRAL)
  for _ in range(600):
    wrench = None if sensor is None else sensor.read(np.broadcast_to(bias, 6))
    arm.step(np.eye(6)[0], None, wrench)
  return arm.velocity


def test_no_error_of_the_sensor_slows_a_free_arm():
  """Of 60 zeroed sensors none does, nor one with all axes off at once."""
  free, largest = speed(), 0.0
  assert free[0] > 0.999
  for seed in range(60):
    sensor = Sensor(np.random.default_rng(seed))
    sensor.zero(np.zeros(6))
    largest = max(largest, load(sensor.read(np.zeros(6))))
    np.testing.assert_allclose(speed(sensor), free, atol=1e-3)
  assert largest > 0.8  # Not far from what counts as a contact.
  corner = np.repeat([FORCE_ACCURACY, TORQUE_ACCURACY], 3)
  np.testing.assert_allclose(speed(Exact(), corner), free, atol=1e-3)


class Exact(Sensor):
  """A sensor without offset."""

  def __init__(self):
    super().__init__(np.random.default_rng(0))
    self._offset = np.zeros(6)


@pytest.mark.parametrize(("force", "least"), [(7.0, 0.999), (7.5, 0.8), (8.0, 0.3)])
def test_a_larger_error_slows_a_free_arm_little_by_little(force, least):
  for direction in np.eye(6)[:3]:
    assert least <= speed(Exact(), force * direction)[0] <= 1.0


def test_stays_near_the_real_arm():
  arm = VirtualArm()
  arm.reset(NEUTRAL)
  for _ in range(500):
    arm.step(np.ones(6), NEUTRAL)
  np.testing.assert_allclose(arm.position, NEUTRAL + DEVIATION)


def test_gives_way_along_the_force():
  arm = VirtualArm(admittance=Admittance())
  arm.reset(NEUTRAL)
  before = arm.model.tool_position(NEUTRAL)
  push = np.zeros(6)
  push[:3] = arm.model.base_mat.T @ [0.0, 20.0, 0.0]  # Along +y of the world.
  for _ in range(100):
    arm.step(np.zeros(6), None, push)
  moved = arm.model.tool_position(arm.position) - before
  assert moved[1] > 1e-3 and np.abs(moved[[0, 2]]).max() < moved[1] / 2
  # The felt part of 20 N against the damping D_c moves it by F / D_c per second.
  assert moved[1] < 0.2 * 20 * ramp(load(push))[1] / Admittance().damping


def test_slope_and_damping_set_in_together():
  """The share of the damping is the slope of the felt force, at every force."""
  sizes = np.linspace(0, 5, 5001)
  shares, parts = np.array([ramp(x) for x in sizes]).T
  slopes = np.gradient(parts * sizes, sizes)
  np.testing.assert_allclose(slopes, shares, atol=1e-3)
  assert not shares[sizes <= 1].any() and (shares[sizes >= 2] == 1).all()
