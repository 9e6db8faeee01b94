"""Transfer between simulators: other physics, other renderers, other looks."""
