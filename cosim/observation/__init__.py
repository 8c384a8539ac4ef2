"""What each AV sees: VelocityMaps, kinematic matrices and their history."""
