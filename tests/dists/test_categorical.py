"""The projection of return distributions against rlax and a loop in numpy."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax

from apnpql_jax.dists import categorical

ATOMS = categorical.support(v_min=-1.0, v_max=2.0, num_atoms=51)


def random_case(seed: int, batch: int = 40):
  """Returns distributions, rewards that leave the support, discounts with zeros."""
  rng = np.random.default_rng(seed)
  probs = rng.dirichlet(np.full(51, 0.3), size=batch)
  reward = rng.uniform(-2.0, 3.0, batch)
  discount = rng.uniform(0.0, 1.0, batch) * (rng.random(batch) < 0.8)
  return tuple(jnp.asarray(x, jnp.float32) for x in (probs, reward, discount))


def loop_projection(probs, reward: float, discount: float, atoms) -> np.ndarray:
  """Computes Algorithm 1 of Bellemare, Dabney and Munos (2017)."""
  low, high = atoms[0], atoms[-1]
  spacing = (high - low) / (len(atoms) - 1)
  out = np.zeros(len(atoms))
  for p, z in zip(probs, atoms, strict=True):
    b = (np.clip(reward + discount * z, low, high) - low) / spacing
    b = min(b, len(atoms) - 1.0)
    left = int(np.floor(b))
    right = min(left + 1, len(atoms) - 1)
    out[left] += p * (left + 1 - b)
    out[right] += p * (b - left)
  return out


def test_projection_matches_the_loop():
  probs, reward, discount = random_case(0)
  ours = jax.jit(categorical.project)(probs, reward, discount, ATOMS)
  atoms = np.asarray(ATOMS, np.float64)
  for i in range(len(reward)):
    expected = loop_projection(
      np.asarray(probs[i], np.float64), float(reward[i]), float(discount[i]), atoms
    )
    np.testing.assert_allclose(ours[i], expected, atol=2e-5)


def test_projection_matches_rlax():
  probs, reward, discount = random_case(1)
  moved = reward[:, None] + discount[:, None] * ATOMS[None]
  expected = jax.vmap(rlax.categorical_l2_project, (0, 0, None))(moved, probs, ATOMS)
  ours = categorical.project(probs, reward, discount, ATOMS)
  np.testing.assert_allclose(ours, expected, atol=2e-5)


def test_projection_of_an_unmoved_distribution_is_itself():
  probs, reward, _ = random_case(3)
  ours = categorical.project(probs, 0.0 * reward, 0.0 * reward + 1.0, ATOMS)
  np.testing.assert_allclose(ours, probs, atol=2e-5)


def test_expectation_over_actions_commutes_with_the_projection():
  """Both sides of paper Eq. 8."""
  rng = np.random.default_rng(4)
  _, reward, discount = random_case(4, batch=5)
  probs = jnp.asarray(rng.dirichlet(np.ones(51), size=(120, 5)), jnp.float32)
  weights = jnp.asarray(rng.dirichlet(np.ones(120), size=5).T, jnp.float32)
  project = functools.partial(
    categorical.project, reward=reward, discount=discount, atoms=ATOMS
  )
  before = project(jnp.sum(weights[..., None] * probs, axis=0))
  after = jnp.sum(weights[..., None] * jax.vmap(project)(probs), axis=0)
  np.testing.assert_allclose(before, after, atol=1e-6)


@pytest.mark.parametrize("expected", [-0.9, 0.0, 0.5, 1.97])
def test_broadest_logits_have_the_mean_and_the_largest_entropy(expected: float):
  atoms = np.asarray(ATOMS, np.float64)
  logits = categorical.broadest_logits(expected, atoms)
  probs = np.asarray(jax.nn.softmax(logits), np.float64)
  assert probs @ atoms == pytest.approx(expected, abs=1e-4)

  # Any small change that keeps mass and mean lowers the entropy.
  def entropy(p: np.ndarray) -> float:
    return float(-np.sum(p * np.log(p + 1e-300)))

  rng = np.random.default_rng(0)
  constraints = np.stack([np.ones_like(atoms), atoms]) * np.sqrt(probs)
  for _ in range(20):
    change = rng.normal(size=atoms.shape)
    change -= constraints.T @ np.linalg.solve(
      constraints @ constraints.T, constraints @ change
    )
    other = probs + 0.1 * change * np.sqrt(probs) * np.sqrt(probs.min())
    assert np.all(other > 0.0)
    assert entropy(other) < entropy(probs) + 1e-9
