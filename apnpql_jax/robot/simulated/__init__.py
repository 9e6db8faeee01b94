"""The simulated robot: a plant in a process of its own, its devices and its cameras."""
