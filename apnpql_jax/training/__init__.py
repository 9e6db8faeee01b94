"""Training: rollouts, the jitted iteration and the host loop around it."""
