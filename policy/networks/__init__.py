"""The agent's neural networks: layouts and forward passes."""
