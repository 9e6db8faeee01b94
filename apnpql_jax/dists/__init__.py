"""Pure mathematics of the agent: distributions and their formulas, no networks."""
