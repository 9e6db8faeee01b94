"""Explanations of actions: what an agent considers at a state before it acts."""

from __future__ import annotations

from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, PRNGKeyArray

from apnpql_jax.agents.acting import choose_action
from apnpql_jax.agents.networks import Heads
from apnpql_jax.agents.table_one import Algorithm
from apnpql_jax.dists import boltzmann
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import Array


class Prior(struct.PyTreeNode):
  """The K components of a regularizer b that is a mixture (paper Sec. IV-A)."""

  shares: Float[Array, "*b k"]
  """Weights of the components; they sum to one."""

  means: Float[Array, "*b k 7"]
  """Means: joint velocities in rad/s, and the probability of closing the gripper."""

  candidates: Int[Array, " s *b"]
  """Component that most probably drew each candidate."""

  chosen: Int[Array, "*b"]
  """Component that most probably drew the action."""


class Explanation(struct.PyTreeNode):
  """An action and what led to it, at ``*b`` states with S candidates each."""

  action: Float[Array, "*b 7"]
  """The action that ``Agent.act`` returns for the same key and rule."""

  action_q: Float[Array, "*b"]
  """Its Q."""

  primitives: Float[Array, "*b 3 7"]
  """Predicted action primitives: joint velocities in rad/s, logit of closing. With
  ``env.true_primitives`` the prior has the true ones instead."""

  candidates: Float[Array, " s *b 7"]
  """Candidates, clipped to the action box. For ap_npql and rows that project by the
  reverse KL, they are those from which the rule "policy" picks the action."""

  q_values: Float[Array, " s *b"]
  """Q of the candidates."""

  weights: Float[Array, " s *b"]
  """Weights of q = b exp(Q / alpha) / Z on the candidates (Eq. 6); they sum to one."""

  alpha: Float[Array, "*b"]
  """Temperature of the state."""

  kl: Float[Array, "*b"]
  """KL(q, b), or KL(pi, b) in rows that project by the reverse KL; nats."""

  ess: Float[Array, "*b"]
  """Effective sample size of ``weights``, between 1 and S."""

  prior: Prior | None
  """Components of the regularizer; None if it is uniform."""

  def at(self, state: int) -> Explanation:
    """Returns the explanation at one of the states ``*b``, a single axis."""
    sampled = ("candidates", "q_values", "weights")  # Their first axis is that of S.

    def picked(node: Any) -> dict[str, Any]:
      return {
        name: x[:, state] if name in sampled else x[state]
        for name, x in vars(node).items()
        if name != "prior"
      }

    prior = self.prior and self.prior.replace(**picked(self.prior))
    return self.replace(**picked(self), prior=prior)


def explain(
  algorithm: Algorithm, heads: Heads, key: PRNGKeyArray, *, acting: str
) -> Explanation:
  """Chooses an action per state, as ``choose_action`` does, and explains it.

  The arguments and errors are those of ``choose_action``.
  """
  action, info = choose_action(algorithm, heads, key, acting=acting)
  draw_key = jax.random.split(key)[0]  # With it, ``choose_action`` draws candidates.
  regularizer = algorithm.regularizer(heads, heads)
  improved = algorithm.policy_update(heads, regularizer, draw_key)
  drawn = improved.candidates
  prior = None
  if isinstance(regularizer, GripperGMM):
    close = jnp.asarray(regularizer.gripper.probs)[..., None]
    prior = Prior(
      shares=jax.nn.softmax(regularizer.logits),
      means=jnp.concatenate([regularizer.loc, close], axis=-1),
      candidates=jnp.argmax(regularizer.responsibilities(drawn.samples), axis=-1),
      chosen=jnp.argmax(regularizer.responsibilities(action[None])[0], axis=-1),
    )
  return Explanation(
    action=action,
    action_q=info["q"],
    primitives=heads.primitives(),
    candidates=drawn.actions,
    q_values=drawn.q_values,
    weights=improved.weights,
    alpha=heads.alpha(),
    kl=improved.kl,
    ess=boltzmann.effective_sample_size(improved.weights),
    prior=prior,
  )
