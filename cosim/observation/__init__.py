"""Observations of an AV: VelocityMaps, kinematic matrices, histories, and the view of an external agent."""
