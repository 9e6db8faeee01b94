"""Mixtures against scipy, distrax and numerical integration."""

from __future__ import annotations

from collections.abc import Callable

from densities import distrax_log_prob, scipy_log_prob
import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special, stats

from apnpql_jax.dists.gmm import GripperGMM


def random_gmm(
  seed: int,
  *,
  batch: tuple[int, ...] = (),
  num: int = 3,
  dim: int = 6,
  spread: float = 1.0,
) -> GripperGMM:
  rng = np.random.default_rng(seed)
  scale = np.tril(0.3 * rng.normal(size=(*batch, num, dim, dim)), k=-1)
  scale = scale + np.eye(dim) * rng.uniform(0.2, 0.8, (*batch, num, dim, 1))
  return GripperGMM(
    logits=jnp.asarray(rng.normal(size=(*batch, num)), jnp.float32),
    loc=jnp.asarray(spread * rng.normal(size=(*batch, num, dim)), jnp.float32),
    scale_tril=jnp.asarray(scale, jnp.float32),
    gripper_logits=jnp.asarray(2.0 * rng.normal(size=(*batch, num)), jnp.float32),
  )


def test_log_prob_matches_scipy_for_every_batch_element():
  mixture = random_gmm(0, batch=(2, 3))
  actions = mixture.sample(seed=jax.random.key(1), sample_shape=50)
  assert actions.shape == (50, 2, 3, 7)
  ours = jax.jit(GripperGMM.log_prob)(mixture, actions)
  for i in np.ndindex(2, 3):
    one = jax.tree.map(lambda x, i=i: x[i], mixture)
    expected = scipy_log_prob(one, np.asarray(actions[(slice(None), *i)]))
    np.testing.assert_allclose(ours[(slice(None), *i)], expected, rtol=1e-4, atol=1e-4)


def test_responsibilities_match_the_densities_of_the_components():
  mixture = random_gmm(0, batch=(2, 3))
  actions = mixture.sample(seed=jax.random.key(1), sample_shape=50)
  found = jax.jit(GripperGMM.responsibilities)(mixture, actions)
  assert found.shape == (50, 2, 3, 3)
  for i in np.ndindex(2, 3):
    one = jax.tree.map(lambda x, i=i: x[i], mixture)
    points = np.asarray(actions[(slice(None), *i)])
    log_weights = special.log_softmax(np.asarray(one.logits, np.float64))
    joint = [
      log_weights[k]
      + scipy_log_prob(jax.tree.map(lambda x, k=k: x[k : k + 1], one), points)
      for k in range(3)
    ]
    expected = special.softmax(joint, axis=0).T
    np.testing.assert_allclose(found[(slice(None), *i)], expected, atol=1e-4)


def assert_gradient(
  grads: GripperGMM, mixture: GripperGMM, function: Callable[[GripperGMM], float]
) -> None:
  """Compares with central differences of a function in double precision."""
  h = 1e-4
  for name in ("logits", "loc", "scale_tril", "gripper_logits"):
    value = np.asarray(getattr(mixture, name), np.float64)
    for i in np.ndindex(value.shape):
      if name == "scale_tril" and i[-1] > i[-2]:
        continue  # not a parameter of a lower-triangular factor
      ends = []
      for sign in (1.0, -1.0):
        moved = value.copy()
        moved[i] += sign * h
        ends.append(function(mixture.replace(**{name: moved})))
      expected = (ends[0] - ends[1]) / (2.0 * h)
      actual = float(getattr(grads, name)[i])
      assert actual == pytest.approx(expected, rel=2e-3, abs=2e-3), (name, i)


def test_log_prob_gradient_matches_finite_differences_of_scipy():
  mixture = random_gmm(3, dim=2)
  actions = np.asarray(mixture.sample(seed=jax.random.key(0), sample_shape=20))
  grads = jax.grad(lambda m: jnp.sum(m.log_prob(jnp.asarray(actions))))(mixture)
  assert_gradient(grads, mixture, lambda m: scipy_log_prob(m, actions).sum())


def test_log_prob_matches_distrax_where_the_gripper_is_a_coin():
  mixture = random_gmm(5, batch=(4,)).replace(gripper_logits=jnp.zeros((4, 3)))
  actions = mixture.sample(seed=jax.random.key(3), sample_shape=30)
  arm = distrax.MixtureSameFamily(
    distrax.Categorical(logits=mixture.logits),
    distrax.MultivariateNormalTri(mixture.loc, mixture.scale_tril),
  )
  expected = arm.log_prob(actions[..., :6]) - np.log(2.0)
  np.testing.assert_allclose(mixture.log_prob(actions), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("num", [1, 3])
@pytest.mark.parametrize("sample_shape", [(), (5,), (2, 3)])
def test_is_a_distrax_distribution_with_the_densities_of_distrax(
  num: int, sample_shape: tuple[int, ...]
):
  mixture = random_gmm(6, batch=(4,), num=num)
  assert isinstance(mixture, distrax.Distribution)
  assert mixture.batch_shape == (4,)
  assert mixture.event_shape == (7,)
  key = jax.random.key(0)
  actions, log_prob = mixture.sample_and_log_prob(seed=key, sample_shape=sample_shape)
  assert actions.shape == (*sample_shape, 4, 7)
  drawn = mixture.sample(seed=key, sample_shape=sample_shape)
  np.testing.assert_array_equal(actions, drawn)
  expected = distrax_log_prob(mixture, actions)
  np.testing.assert_allclose(log_prob, expected, rtol=1e-4, atol=1e-4)
  np.testing.assert_allclose(mixture.log_prob(actions), expected, rtol=1e-4, atol=1e-4)


def test_log_prob_is_the_same_under_vmap_and_scan():
  mixture = random_gmm(9, batch=(4,))
  actions = mixture.sample(seed=jax.random.key(2), sample_shape=5)
  expected = mixture.log_prob(actions)
  mapped = jax.vmap(GripperGMM.log_prob, in_axes=(0, 1), out_axes=1)(mixture, actions)
  _, scanned = jax.lax.scan(lambda m, a: (m, m.log_prob(a)), mixture, actions)
  np.testing.assert_allclose(mapped, expected, rtol=1e-5, atol=1e-5)
  np.testing.assert_allclose(scanned, expected, rtol=1e-5, atol=1e-5)


def test_entropy_bound_of_one_component_is_the_entropy_of_distrax():
  mixture = random_gmm(12, batch=(4,), num=1)
  arm = distrax.MultivariateNormalTri(mixture.loc, mixture.scale_tril)
  gripper = distrax.Bernoulli(logits=mixture.gripper_logits)
  expected = jnp.squeeze(arm.entropy() + gripper.entropy(), axis=-1)
  np.testing.assert_allclose(mixture.entropy_bound(), expected, rtol=1e-5, atol=1e-5)


def test_samples_have_the_moments_of_the_mixture():
  mixture = random_gmm(4)
  actions = np.asarray(mixture.sample(seed=jax.random.key(2), sample_shape=200_000))
  weights = special.softmax(np.asarray(mixture.logits))
  means = np.asarray(mixture.loc)
  scale = np.asarray(mixture.scale_tril)
  mean = weights @ means
  second = np.einsum(
    "k,kij->ij",
    weights,
    scale @ scale.swapaxes(-1, -2) + means[:, :, None] * means[:, None],
  )
  arm = actions[:, :6]
  np.testing.assert_allclose(arm.mean(0), mean, atol=0.02)
  np.testing.assert_allclose(np.cov(arm.T), second - np.outer(mean, mean), atol=0.03)
  close = weights @ special.expit(np.asarray(mixture.gripper_logits))
  assert set(np.unique(actions[:, 6])) == {0.0, 1.0}
  assert actions[:, 6].mean() == pytest.approx(close, abs=0.005)


def test_every_component_draws_for_itself():
  """Whitened, the draws of all components are independent standard normals."""
  mixture, n = random_gmm(7, batch=(2,)), 10_000
  drawn = np.asarray(mixture.sample_each(jax.random.key(0), n), np.float64)
  assert drawn.shape == (n, 3, 2, 6)
  for state in range(2):
    one = jax.tree.map(lambda x, i=state: np.asarray(x[i], np.float64), mixture)
    centered = (drawn[:, :, state] - one.loc)[..., None]
    white = np.linalg.solve(one.scale_tril, centered).reshape(n, -1)
    assert np.abs(white.mean(0)).max() < 5.0 / np.sqrt(n)
    assert np.abs(np.cov(white.T) - np.eye(18)).max() < 5.0 * np.sqrt(2.0 / n)
    assert stats.kstest(white.ravel(), "norm").pvalue > 1e-3


def test_one_component_draws_for_itself_what_the_mixture_draws():
  mixture, key = random_gmm(8, batch=(2,), num=1), jax.random.key(0)
  sampled = mixture.sample(seed=key, sample_shape=5)[..., :-1]
  np.testing.assert_array_equal(mixture.sample_each(key, 5)[:, 0], sampled)


def test_gripper_belongs_to_the_component_of_the_arm():
  mixture = GripperGMM(
    logits=jnp.zeros(2),
    loc=jnp.array([[-10.0] * 6, [10.0] * 6]),
    scale_tril=jnp.tile(0.1 * jnp.eye(6), (2, 1, 1)),
    gripper_logits=jnp.array([-2.0, 1.0]),
  )
  actions = np.asarray(mixture.sample(seed=jax.random.key(0), sample_shape=50_000))
  left = actions[:, 0] < 0.0
  assert actions[left, 6].mean() == pytest.approx(special.expit(-2.0), abs=0.01)
  assert actions[~left, 6].mean() == pytest.approx(special.expit(1.0), abs=0.01)


def integrated_entropy(mixture: GripperGMM) -> float:
  """Integrates the entropy of a mixture over one joint velocity and the gripper."""
  x = np.linspace(-30.0, 30.0, 60_001)
  total = 0.0
  for gripper in (0.0, 1.0):
    log_p = scipy_log_prob(mixture, np.stack([x, np.full_like(x, gripper)], axis=-1))
    total += integrate.simpson(-np.exp(log_p) * log_p, x=x)
  return total


@pytest.mark.parametrize("seed", range(6))
def test_entropy_bound_lies_below_the_integral_and_above_the_components(seed: int):
  mixture = random_gmm(seed, dim=1, spread=1.5)
  bound = float(mixture.entropy_bound())
  entropy = integrated_entropy(mixture)
  weights = special.softmax(np.asarray(mixture.logits))
  conditional = float(weights @ np.asarray(mixture.component_entropy()))
  assert conditional - 1e-5 <= bound <= entropy + 1e-5
  # The gap to the truth is at most what is unknown: which component it was.
  assert entropy - bound < stats.entropy(weights)


@pytest.mark.parametrize("case", ["one", "equal", "far_arm", "far_gripper"])
def test_entropy_bound_is_exact_at_the_extremes(case: str):
  mixture = random_gmm(7, dim=1)
  if case == "one":
    mixture = random_gmm(7, dim=1, num=1)
  elif case == "equal":
    first = jax.tree.map(lambda x: jnp.repeat(x[:1], 3, axis=0), mixture)
    mixture = first.replace(logits=mixture.logits)
  elif case == "far_arm":
    mixture = mixture.replace(loc=jnp.array([[-9.0], [0.0], [9.0]]))
  else:
    mixture = random_gmm(7, dim=1, num=2)
    mixture = mixture.replace(gripper_logits=jnp.array([-30.0, 30.0]))
  bound = float(mixture.entropy_bound())
  assert bound == pytest.approx(integrated_entropy(mixture), abs=2e-4)


def test_entropy_bound_in_six_dimensions_against_monte_carlo():
  mixture = random_gmm(11, spread=0.7)
  actions = np.asarray(mixture.sample(seed=jax.random.key(5), sample_shape=40_000))
  surprise = -scipy_log_prob(mixture, actions)
  error = surprise.std() / np.sqrt(surprise.size)
  bound = float(mixture.entropy_bound())
  assert bound <= surprise.mean() + 4.0 * error
  assert bound >= surprise.mean() - 0.7


def numpy_bound(mixture: GripperGMM) -> float:
  """Computes the pairwise bound, written out in double precision."""
  scale = np.asarray(mixture.scale_tril, np.float64)
  covariance = scale @ scale.swapaxes(-1, -2)
  weights = special.softmax(np.asarray(mixture.logits, np.float64))
  probability = special.expit(np.asarray(mixture.gripper_logits, np.float64))
  total = 0.0
  for i, weight in enumerate(weights):
    overlaps = []
    for j in range(len(weights)):
      middle = 0.5 * (covariance[i] + covariance[j])
      d = np.asarray(mixture.loc[i] - mixture.loc[j], np.float64)
      dets = [np.linalg.det(c) for c in (covariance[i], covariance[j], middle)]
      arm = (dets[0] * dets[1]) ** 0.25 / np.sqrt(dets[2])
      arm *= np.exp(-0.125 * d @ np.linalg.solve(middle, d))
      gripper = np.sqrt(probability[i] * probability[j])
      gripper += np.sqrt((1.0 - probability[i]) * (1.0 - probability[j]))
      overlaps.append(arm * gripper)
    own = stats.multivariate_normal(cov=covariance[i]).entropy()
    own += stats.bernoulli(probability[i]).entropy()
    total += weight * (own - np.log(weights @ np.array(overlaps)))
  return float(total)


def test_entropy_bound_and_its_gradient_match_the_formula_in_double_precision():
  mixture = random_gmm(2, dim=3, spread=0.5)
  value, grads = jax.value_and_grad(GripperGMM.entropy_bound)(mixture)
  assert value == pytest.approx(numpy_bound(mixture), abs=1e-4)
  assert_gradient(grads, mixture, numpy_bound)


def test_entropy_bound_of_a_batch_is_that_of_its_elements():
  mixture = random_gmm(8, batch=(2, 3))
  ours = jax.jit(GripperGMM.entropy_bound)(mixture)
  for i in np.ndindex(2, 3):
    one = jax.tree.map(lambda x, i=i: x[i], mixture)
    assert ours[i] == pytest.approx(numpy_bound(one), abs=1e-3)


def test_entropy_and_density_stay_finite_where_the_gripper_is_certain():
  mixture = random_gmm(1).replace(gripper_logits=jnp.array([-60.0, 60.0, 0.0]))
  actions = mixture.sample(seed=jax.random.key(0), sample_shape=10)

  def total(mixture: GripperGMM) -> jax.Array:
    return mixture.entropy_bound() + jnp.mean(mixture.log_prob(actions))

  value, grads = jax.value_and_grad(total)(mixture)
  assert np.isfinite(value)
  assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(grads))
