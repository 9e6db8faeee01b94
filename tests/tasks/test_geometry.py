"""Headings, rotations and funnels against scipy and their definitions."""

from __future__ import annotations

from hand_made import MOTIONS
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from apnpql_jax.tasks import geometry


def same_angle(actual, desired, atol: float) -> None:
  """Checks that angles are equal as points of the circle."""
  difference = np.asarray(actual, np.float64) - desired
  np.testing.assert_allclose(np.sin(difference), 0, atol=atol)
  assert (np.cos(difference) > 0).all()


def test_yaw_is_the_heading_of_the_x_axis():
  """For any orientation whose x axis is not too steep to have a heading."""
  rotation = Rotation.random(2000, rng=np.random.default_rng(0))
  mat = rotation.as_matrix()
  level = np.hypot(mat[:, 0, 0], mat[:, 1, 0]) > 0.1
  assert level.mean() > 0.95
  quat = jnp.asarray(rotation.as_quat(scalar_first=True), jnp.float32)
  heading = np.arctan2(mat[:, 1, 0], mat[:, 0, 0])
  same_angle(geometry.yaw(quat)[level], heading[level], atol=1e-4)


def test_yaw_of_an_upright_body_is_its_angle_for_both_signs_of_the_quaternion():
  angle = np.linspace(-3.1, 3.1, 63)
  quat = Rotation.from_euler("z", angle[:, None]).as_quat(scalar_first=True)
  quat = jnp.asarray(quat, jnp.float32)
  np.testing.assert_allclose(geometry.yaw(quat), angle, atol=1e-5)
  np.testing.assert_allclose(geometry.yaw(-quat), angle, atol=1e-5)


@pytest.mark.parametrize("index", [0, 1, 2])
def test_axis_is_a_column_of_scipys_matrix(index):
  rotation = Rotation.random(60, rng=np.random.default_rng(5))
  quat = jnp.asarray(rotation.as_quat(scalar_first=True), jnp.float32)
  axis = geometry.axis(quat.reshape(20, 3, 4), index)
  expected = rotation.as_matrix()[:, :, index].reshape(20, 3, 3)
  np.testing.assert_allclose(axis, expected, atol=1e-6)


@pytest.mark.parametrize("period", [np.pi / 2, np.pi, 2 * np.pi])
def test_fold_is_the_nearest_equivalent(period):
  angle = np.random.default_rng(1).uniform(-20, 20, 1000)
  folded = np.asarray(geometry.fold(jnp.asarray(angle, jnp.float32), period))
  assert np.abs(folded).max() <= period / 2 + 1e-5
  turns = (angle - folded) / period
  np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)
  # Nearest to zero among all equivalents.
  every = angle[:, None] + period * np.arange(-14, 15)
  np.testing.assert_allclose(np.abs(folded), np.abs(every).min(1), atol=1e-5)


def test_fold_keeps_folded_angles():
  angle = jnp.array([-0.78, -0.3, 0.0, 0.3, 0.78])
  np.testing.assert_array_equal(geometry.fold(angle, np.pi / 2), angle)


def test_rotation_z_is_scipys_rotation():
  angle = np.random.default_rng(2).uniform(-7, 7, 60)
  expected = Rotation.from_euler("z", angle[:, None]).as_matrix()
  turned = geometry.rotation_z(jnp.asarray(angle, jnp.float32).reshape(20, 3))
  np.testing.assert_allclose(turned, expected.reshape(20, 3, 3, 3), atol=1e-6)


def test_a_rotation_adds_to_the_heading():
  """rotation_z and yaw have the same sign."""
  rotation = Rotation.from_euler(
    "zyx", np.random.default_rng(3).uniform(-0.5, 0.5, (50, 3))
  )
  before = jnp.asarray(rotation.as_quat(scalar_first=True), jnp.float32)
  turn = np.asarray(geometry.rotation_z(jnp.full(50, 0.7)))
  after = (Rotation.from_matrix(turn) * rotation).as_quat(scalar_first=True)
  difference = geometry.yaw(jnp.asarray(after, jnp.float32)) - geometry.yaw(before)
  same_angle(difference, 0.7, atol=1e-5)


@pytest.mark.parametrize(
  ("off", "expected"),
  [
    (0.0, 0.0),
    (0.01, 0.0),
    (0.02, 0.25),
    (0.03, 0.5),
    (0.04, 0.75),
    (0.05, 1.0),
    (0.3, 1.0),
  ],
)
def test_funnel_at_its_ends_and_between(off, expected):
  value = geometry.funnel(jnp.array([off]), aligned=0.01, wide=0.05)
  np.testing.assert_allclose(value, [expected], atol=1e-6)


@pytest.mark.parametrize("height", [0.3, np.array([0.3, 0.4])])
def test_at_height_adds_a_height(height):
  xy = jnp.array([[1.0, 2.0], [3.0, 4.0]])
  expected = np.column_stack([xy, np.broadcast_to(height, 2)])
  np.testing.assert_allclose(geometry.at_height(xy, height), expected, rtol=1e-6)


def test_rest_limits_every_direction_and_axis():
  dof, speed, rests = map(np.array, zip(*MOTIONS, strict=True))
  twist = np.zeros((len(dof), 6), np.float32)
  twist[np.arange(len(dof)), dof] = speed
  np.testing.assert_array_equal(geometry.is_at_rest(jnp.asarray(twist)), rests)
  # Components add up as vectors; turning and moving are separate.
  for twist, expected in (
    ([0.04, 0.04, 0, 0, 0, 0], False),
    ([0, 0, 0, 0.4, 0, -0.4], False),
    ([0.04, 0, 0, 0.4, 0, 0], True),
  ):
    assert geometry.is_at_rest(jnp.array([twist]))[0] == expected


def test_norm_has_a_gradient_at_zero():
  x = np.random.default_rng(4).normal(size=(20, 3))
  np.testing.assert_allclose(
    geometry.norm(jnp.asarray(x, jnp.float32)), np.linalg.norm(x, axis=1), rtol=1e-5
  )
  np.testing.assert_array_equal(jax.grad(geometry.norm)(jnp.zeros(3)), np.zeros(3))
