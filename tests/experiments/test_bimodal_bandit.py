"""The claim of the paper: q keeps both of two good actions, a projection cannot."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import runpy

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
BANDIT = runpy.run_path(str(ROOT / "experiments" / "results" / "bimodal_bandit.py"))


@pytest.fixture(scope="module")
def played() -> dict[str, tuple[np.ndarray, float]]:
  """Returns algorithm -> share of its actions at either peak, mean reward."""
  found = {}
  for name in BANDIT["ALGORITHMS"]:
    config = dataclasses.replace(BANDIT["CONFIG"], algorithm=name)
    actions = BANDIT["play"](config, updates=500, draws=1000)
    peak = BANDIT["nearest"](actions)
    shares = np.array([np.mean(peak == i) for i in (0, 1)])
    found[name] = shares, float(BANDIT["reward"](actions).mean())
  return found


def test_the_non_parametric_policy_keeps_both_peaks(played):
  shares, reward = played["ap_npql"]
  assert shares.min() > 0.2 and shares.sum() > 0.85
  assert reward > 0.55


def test_forward_kl_covers_both_and_hits_neither(played):
  shares, reward = played["ap_mpo"]
  assert shares.min() > 0.02 and shares.sum() < 0.6
  assert reward < 0.5 * played["ap_npql"][1]


def test_reverse_kl_keeps_one(played):
  shares, reward = played["ap_sac"]
  assert shares.min() < 0.02 and shares.max() > 0.6
  assert reward > played["ap_mpo"][1]
