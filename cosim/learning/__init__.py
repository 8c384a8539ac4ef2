"""Where agent and world meet: training from rollouts and recordings, measurements of predictions."""
