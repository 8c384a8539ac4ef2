"""What each AV sees: VelocityMaps, kinematic matrices and their history."""

from cosim.observation.observer import Observer

__all__ = ["Observer"]
