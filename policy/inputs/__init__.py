"""What the networks and rules are given: the joined scene, situation, meetings, tensors."""
