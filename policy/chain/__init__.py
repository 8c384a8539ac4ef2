"""The multi-step prediction chain (P, figure 4 and algorithm 1), and the error of its maps."""
