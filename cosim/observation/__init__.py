"""What an AV observes: VelocityMaps, kinematic matrices, histories, and the view of an external agent."""
