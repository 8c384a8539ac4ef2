"""Agent and simulation together: training from rollouts and recordings, measurements of predictions."""
