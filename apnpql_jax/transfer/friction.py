"""Friction of MuJoCo's contact pairs, converted to one factor per link for PyBullet.

MuJoCo has a friction per pair of geoms, Bullet one per link: the friction of a contact
is the product of two factors. Bullet's contacts are rigid; a time constant and an
impedance, as MuJoCo has them, are not transferred.
"""

from __future__ import annotations

from collections import defaultdict

import mujoco
import numpy as np


def sliding(model: mujoco.MjModel) -> dict[int, float]:
  """Returns a factor for each body whose products are the frictions of the pairs.

  Of several frictions between two bodies, the median counts. If no factors are exact,
  they are the least-squares solution for the logarithms.
  """
  found = defaultdict(list)
  for pair, bodies in enumerate(_bodies(model)):
    found[tuple(sorted(bodies))].append(model.pair_friction[pair, 0])
  used = sorted({body for pair in found for body in pair})
  rows, wanted = np.zeros((len(found), len(used))), np.zeros(len(found))
  for row, (pair, frictions) in enumerate(found.items()):
    for body in pair:
      rows[row, used.index(body)] += 1.0
    wanted[row] = np.log(max(float(np.median(frictions)), 1e-6))
  factors = np.exp(np.linalg.lstsq(rows, wanted, rcond=None)[0])
  return dict(zip(used, factors.tolist(), strict=True))


def spinning(model: mujoco.MjModel) -> dict[int, float]:
  """Returns Bullet's spinning friction (m) of each body with torsional friction.

  Bullet adds each body's own one times the sliding factor of the other. The first body
  of a pair, which is the hand, carries it.
  """
  factors, found = sliding(model), {}
  for pair, (first, second) in enumerate(_bodies(model)):
    if model.pair_dim[pair] >= 4:
      torsion = model.pair_friction[pair, 2] / factors[second]
      found[first] = max(found.get(first, 0.0), float(torsion))
  return found


def _bodies(model: mujoco.MjModel) -> list[tuple[int, int]]:
  """Returns the bodies of each pair of geoms."""
  geoms = zip(model.pair_geom1, model.pair_geom2, strict=True)
  return [(int(model.geom_bodyid[a]), int(model.geom_bodyid[b])) for a, b in geoms]
