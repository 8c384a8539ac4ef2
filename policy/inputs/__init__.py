"""Inputs of networks and rules: the joined scene, situation, mission conflicts, tensors."""
