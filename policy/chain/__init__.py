"""The multi-step prediction chain (P, figure 4 and algorithm 1), and how good its maps are."""
