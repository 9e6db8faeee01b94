"""The learning agent: networks, losses, the rows of Table I and the learner."""
