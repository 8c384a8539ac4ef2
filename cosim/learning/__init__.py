"""What joins agent and simulation: training from rollouts and recordings, measurements of predictions."""
